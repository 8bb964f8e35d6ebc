-- Objects and Places for `mapfold query` and `serve`. Properties are agtype, parsed as JSON;
-- `ag_catalog.agtype_access_operator` with a constant key is what the btree indexes serve.

-- name: places
SELECT id::text, properties FROM {place} ORDER BY id

-- name: edges
SELECT start_id::text, end_id::text, properties FROM {adjacent_to} ORDER BY id

-- name: objects
-- All Objects with the Place they are located in, if any.
SELECT thing.properties, its.properties
FROM {object} AS thing
LEFT JOIN {located_in} AS located ON located.start_id = thing.id
LEFT JOIN {place} AS its ON its.id = located.end_id
ORDER BY thing.id

-- name: object
SELECT thing.properties, its.properties
FROM {object} AS thing
LEFT JOIN {located_in} AS located ON located.start_id = thing.id
LEFT JOIN {place} AS its ON its.id = located.end_id
WHERE ag_catalog.agtype_access_operator(VARIADIC ARRAY[thing.properties, '"object_id"'::ag_catalog.agtype])
    = %(id)s::text::ag_catalog.agtype

-- name: objects_of_place
SELECT thing.properties, its.properties
FROM {place} AS its
JOIN {located_in} AS located ON located.end_id = its.id
JOIN {object} AS thing ON thing.id = located.start_id
WHERE ag_catalog.agtype_access_operator(VARIADIC ARRAY[its.properties, '"place_id"'::ag_catalog.agtype])
    = %(id)s::text::ag_catalog.agtype
ORDER BY thing.id

-- name: object_counts
-- Places with Objects of a class, how many, and how many of them are confirmed.
SELECT located.end_id::text, count(*),
       count(*) FILTER (WHERE ag_catalog.agtype_access_operator(VARIADIC ARRAY[thing.properties, '"confirmed"'::ag_catalog.agtype]) = 'true'::ag_catalog.agtype)
FROM {object} AS thing JOIN {located_in} AS located ON located.start_id = thing.id
WHERE ag_catalog.agtype_access_operator(VARIADIC ARRAY[thing.properties, '"class_name"'::ag_catalog.agtype])
    = %(id)s::text::ag_catalog.agtype
GROUP BY 1

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
