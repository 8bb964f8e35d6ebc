-- Objects and Places for `mapfold find`, `room`, `path` and `serve`. Properties are agtype, parsed as
-- JSON; `ag_catalog.agtype_access_operator` with a constant key is what the btree indexes serve.

-- name: places
SELECT id::text, properties FROM {place} ORDER BY id

-- name: edges
SELECT start_id::text, end_id::text, properties FROM {adjacent_to} ORDER BY id

-- name: runs
SELECT id::text, properties FROM {run} ORDER BY id

-- name: objects
-- All Objects with the Place they are located in, if any.
SELECT thing.id::text, thing.properties, located.end_id::text
FROM {object} AS thing
LEFT JOIN {located_in} AS located ON located.start_id = thing.id
ORDER BY thing.id

-- name: keyframes
-- All keyframes with their run, their pose and the Place they are in, where they have one.
SELECT keyframe.id::text, its.start_id::text, keyframe.properties, pose.properties,
       placed.end_id::text
FROM {keyframe} AS keyframe
JOIN {has_keyframe} AS its ON its.end_id = keyframe.id
LEFT JOIN {has_pose} AS posed ON posed.start_id = keyframe.id
LEFT JOIN {pose} AS pose ON pose.id = posed.end_id
LEFT JOIN {in_place} AS placed ON placed.start_id = keyframe.id
ORDER BY keyframe.id

-- name: sightings
-- Of each observation of an Object, by its number: the Object and the keyframe.
SELECT seen.end_id::text, made.start_id::text
FROM {observes} AS seen
JOIN {has_observation} AS made ON made.end_id = seen.start_id
ORDER BY seen.start_id

-- name: object_observations
-- In one row: the ids of all Objects and their names, and the observations of Objects and whose they are.
SELECT ARRAY(SELECT id FROM {object} ORDER BY id)::text::bigint[],
       ARRAY(SELECT ag_catalog.agtype_access_operator(
                 VARIADIC ARRAY[properties, '"object_id"'::ag_catalog.agtype])::text
             FROM {object} ORDER BY id),
       ARRAY(SELECT start_id FROM {observes} ORDER BY start_id)::text::bigint[],
       ARRAY(SELECT end_id FROM {observes} ORDER BY start_id)::text::bigint[]

-- name: near_places
SELECT properties FROM {place}
WHERE ag_catalog.agtype_access_operator(VARIADIC ARRAY[properties, '"centroid_x"'::ag_catalog.agtype])::float8
        BETWEEN %(x0)s AND %(x1)s
  AND ag_catalog.agtype_access_operator(VARIADIC ARRAY[properties, '"centroid_y"'::ag_catalog.agtype])::float8
        BETWEEN %(y0)s AND %(y1)s

-- name: near_objects
-- By estimate where there is one, as fusion by evidence makes it.
SELECT properties FROM {object}
WHERE coalesce(
        ag_catalog.agtype_access_operator(VARIADIC ARRAY[properties, '"est_x"'::ag_catalog.agtype]),
        ag_catalog.agtype_access_operator(VARIADIC ARRAY[properties, '"mean_x"'::ag_catalog.agtype])
    )::float8 BETWEEN %(x0)s AND %(x1)s
  AND coalesce(
        ag_catalog.agtype_access_operator(VARIADIC ARRAY[properties, '"est_y"'::ag_catalog.agtype]),
        ag_catalog.agtype_access_operator(VARIADIC ARRAY[properties, '"mean_y"'::ag_catalog.agtype])
    )::float8 BETWEEN %(y0)s AND %(y1)s

-- name: page_of_places
-- The next ones by id, which is the order of their founding.
SELECT id::text, properties FROM {place}
WHERE id OPERATOR(ag_catalog.>) %(after)s::text::ag_catalog.graphid ORDER BY id LIMIT %(most)s

-- name: page_of_objects
-- The next ones by id, with the Place that each is located in, if any.
SELECT thing.id::text, thing.properties, its.properties
FROM {object} AS thing
LEFT JOIN {located_in} AS located ON located.start_id = thing.id
LEFT JOIN {place} AS its ON its.id = located.end_id
WHERE thing.id OPERATOR(ag_catalog.>) %(after)s::text::ag_catalog.graphid
ORDER BY thing.id LIMIT %(most)s
