-- From crops to candidates: the nearest observations, or those of a class; of each its Object, the
-- Object's Place, and the Place of its keyframe. Graph ids follow from the observation's number (det_pk),
-- so every step but the search is a look-up of an indexed id. `{questions}` is a VALUES list of (crop,
-- vector) bind parameters. `origin` is log id, and fingerprint of settings and of what the observations
-- depend on.
-- Other words in braces are the parts of these names below.

-- name: cosines
-- Key, number, mean and deviation of the cosines of different things in one picture, of the sample of
-- projections/localize/relocalize/constants.py; null when the key is the one that the reader already knows. The
-- sample changes when the number of observations has doubled, or with each of the first ones.
(SELECT CASE WHEN sampled.key IS DISTINCT FROM %(known_cosines)s::text THEN (
    SELECT json_build_array(sampled.key, count(*), coalesce(avg(1 - (one.embedding <=> other.embedding)), 0),
                            coalesce(stddev_pop(1 - (one.embedding <=> other.embedding)), 0))
    FROM generate_series(sampled.stride, sampled.edge, sampled.stride) AS picked (det_pk)
    JOIN public.detection_embeddings AS one USING (det_pk)
    JOIN public.detection_embeddings AS other
        ON other.det_pk BETWEEN one.det_pk + 1 AND one.det_pk + %(followers)s
        AND other.run_id = one.run_id AND other.keyframe_id = one.keyframe_id
        AND other.class_name <> one.class_name
 ) END
 FROM (
    SELECT edge, greatest(1, CASE WHEN number > %(sampled)s THEN edge / %(sampled)s ELSE 1 END) AS stride,
           (SELECT log_id || ' ' || observed
            FROM mapfold.checkpoint WHERE sink = 'vectors') || ' ' || edge AS key
    FROM (
        SELECT number, CASE WHEN number > %(sampled)s
            THEN 1::bigint << (length(ltrim(number::bit(64)::text, '0')) - 1) ELSE number END AS edge
        FROM (SELECT coalesce(max(det_pk), 0) AS number FROM public.detection_embeddings) AS last
    ) AS limited
 ) AS sampled)

-- name: settings
-- Fingerprint and settings of the graph; null when the fingerprint is the one already known.
(SELECT CASE WHEN fingerprint IS DISTINCT FROM %(known_settings)s::text
    THEN json_build_array(fingerprint, settings) END
 FROM mapfold.checkpoint WHERE sink = 'graph')

-- name: maps
-- Key of the occupancy maps, which is null if there are none, in an array; null when the key is the one
-- already known.
(SELECT CASE WHEN maps IS DISTINCT FROM %(known_maps)s::text THEN json_build_array(maps) END
 FROM mapfold.checkpoint WHERE sink = 'graph')

-- name: of_vectors
-- What is to know of the vectors as a whole, in one of the rows.
CASE WHEN row_number() OVER () = 1 THEN json_build_array({cosines}, (
    SELECT log_id || ' ' || observed
    FROM mapfold.checkpoint WHERE sink = 'vectors')) END

-- name: of_graph
-- The same of the graph, and in the same row the properties of the Objects and Places in `followed`, by id.
-- `concat`, as AGE 1.5 casts only scalars to text.
CASE WHEN row_number() OVER () = 1 THEN json_build_array({settings}, (
    SELECT log_id || ' ' || observed
    FROM mapfold.checkpoint WHERE sink = 'graph'), {maps},
    (SELECT json_object_agg(id::text, concat(properties)) FROM {object}
     WHERE id = ANY(ARRAY(SELECT thing FROM observes))),
    (SELECT json_object_agg(id::text, concat(properties)) FROM {place}
     WHERE id = ANY(ARRAY(SELECT place FROM located UNION SELECT place FROM in_place)))) END,
{edges}

-- name: edges
-- The edges in `followed`, also in that row: two columns each.
CASE WHEN row_number() OVER () = 1 THEN ARRAY(SELECT observation FROM observes)::text::bigint[] END,
CASE WHEN row_number() OVER () = 1 THEN ARRAY(SELECT thing FROM observes)::text::bigint[] END,
CASE WHEN row_number() OVER () = 1 THEN ARRAY(SELECT thing FROM located)::text::bigint[] END,
CASE WHEN row_number() OVER () = 1 THEN ARRAY(SELECT place FROM located)::text::bigint[] END,
CASE WHEN row_number() OVER () = 1 THEN ARRAY(SELECT observation FROM has)::text::bigint[] END,
CASE WHEN row_number() OVER () = 1 THEN ARRAY(SELECT keyframe FROM has)::text::bigint[] END,
CASE WHEN row_number() OVER () = 1 THEN ARRAY(SELECT keyframe FROM in_place)::text::bigint[] END,
CASE WHEN row_number() OVER () = 1 THEN ARRAY(SELECT place FROM in_place)::text::bigint[] END

-- name: observed
near.det_pk, near.det_id, near.run_id, near.class_name, near.bbox::text AS bbox, near.map_x, near.map_y,
near.map_yaw, near.camera, near.embedding_model

-- name: followed
-- From `found.det_pk` along the graph: to Objects and on to their Places, and to keyframes and on to theirs.
-- Each table is read once for all ids, in their order: the observations of an Object lie close together.
observes AS MATERIALIZED (
    SELECT start_id AS observation, end_id AS thing FROM {observes}
    WHERE start_id = ANY(ARRAY(SELECT ag_catalog._graphid(%(observation)s, coalesce(det_pk, 0)) FROM found))
), located AS MATERIALIZED (
    SELECT start_id AS thing, end_id AS place FROM {located_in}
    WHERE start_id = ANY(ARRAY(SELECT thing FROM observes))
), has AS MATERIALIZED (
    SELECT end_id AS observation, start_id AS keyframe FROM {has_observation}
    WHERE end_id = ANY(ARRAY(SELECT ag_catalog._graphid(%(observation)s, coalesce(det_pk, 0)) FROM found))
), in_place AS MATERIALIZED (
    SELECT start_id AS keyframe, end_id AS place FROM {in_place}
    WHERE start_id = ANY(ARRAY(SELECT keyframe FROM has))
)

-- name: indexed
-- Whether there is an index of halves, and it may be used.
(SELECT current_setting('enable_indexscan')::boolean AND EXISTS (
    SELECT 1 FROM pg_catalog.pg_index
    WHERE indexrelid = to_regclass('public.detection_embeddings_halves')
      AND indrelid = to_regclass('public.detection_embeddings')))

-- name: nearest
-- The observations nearest to `question.wanted`: of those that the index finds, by vectors of half
-- precision, or of all. One of the two sub-selects is never run.
SELECT det_pk, det_id, run_id, class_name, bbox, map_x, map_y, map_yaw, camera, embedding_model,
       embedding <=> question.wanted AS distance
FROM (
    (SELECT * FROM public.detection_embeddings WHERE {indexed}
     ORDER BY embedding::halfvec({dimension}) <=> question.wanted::halfvec({dimension}) LIMIT {candidates})
    UNION ALL
    (SELECT * FROM public.detection_embeddings WHERE NOT {indexed}
     ORDER BY embedding <=> question.wanted LIMIT {neighbours})
) AS found ORDER BY distance LIMIT {neighbours}

-- name: near
-- The nearest observations of each crop, from the vectors' database; at least one row, of nulls if there
-- is no observation. Their number is a constant: with a parameter the server would plan every question
-- anew, because a plan for any number is dearer.
WITH question (crop, wanted) AS ({questions})
SELECT {of_vectors}, question.crop, 1 - near.distance, {observed}
FROM question LEFT JOIN LATERAL ({nearest}) AS near ON true

-- name: described
-- These observations, from the vectors' database; at least one row.
SELECT {of_vectors}, 0, 1.0, {observed}
FROM (SELECT 1) AS one
LEFT JOIN public.detection_embeddings AS near ON near.det_pk = ANY(%(det_pks)s::bigint[])

-- name: bare
-- These observations, the poses of their keyframes, and these, from the graph's database: of those that
-- have no embedding the vectors' has no row. A Pose has the number of its keyframe.
SELECT seen.id::text::bigint & 281474976710655, concat(seen.properties), concat(pose.properties),
       concat(keyframe.properties)
FROM {observation} AS seen
JOIN {has_observation} AS has ON has.end_id = seen.id
JOIN {keyframe} AS keyframe ON keyframe.id = has.start_id
JOIN {pose} AS pose ON pose.id = ag_catalog._graphid(%(pose)s, has.start_id::text::bigint & 281474976710655)
WHERE seen.id = ANY(ARRAY(SELECT ag_catalog._graphid(%(observation)s, det_pk)
                          FROM unnest(%(det_pks)s::bigint[]) AS given (det_pk)))

-- name: graph
-- Object, its Place and the keyframe's Place of these observations, from the graph's database, in one row.
WITH found AS MATERIALIZED (
    SELECT det_pk FROM unnest(%(det_pks)s::bigint[]) AS given (det_pk)
), {followed}
SELECT {of_graph}

-- name: near_and_graph
-- Both in one round trip and one snapshot, when they share a database.
WITH question (crop, wanted) AS ({questions}), found AS MATERIALIZED (
    SELECT question.crop, 1 - near.distance AS similarity, {observed}
    FROM question LEFT JOIN LATERAL ({nearest}) AS near ON true
), {followed}
SELECT {of_vectors}, crop, similarity, det_pk, det_id, run_id, class_name, bbox, map_x, map_y, map_yaw,
       camera, embedding_model, {of_graph}
FROM found

-- name: of_classes
-- Observations of the Objects of each class, from the graph's database: the Objects that were seen most
-- often, and of each some observations spread evenly over all. `%(patterns)s` are properties to match.
SELECT wanted.number, seen.starts[picked.position]::text::bigint & 281474976710655 AS det_pk
FROM unnest(%(patterns)s::text[]) WITH ORDINALITY AS wanted (pattern, number)
CROSS JOIN LATERAL (
    SELECT id FROM {object}
    WHERE properties OPERATOR(ag_catalog.@>) wanted.pattern::ag_catalog.agtype
    ORDER BY ag_catalog.agtype_access_operator(
        VARIADIC ARRAY[properties, '"obs_count"'::ag_catalog.agtype])::int8 DESC, id
    LIMIT %(objects)s
) AS thing
CROSS JOIN LATERAL (
    SELECT array_agg(start_id ORDER BY start_id) AS starts FROM {observes} WHERE end_id = thing.id
) AS seen
CROSS JOIN LATERAL (
    SELECT DISTINCT (step * cardinality(seen.starts) + %(of_each)s - 1) / %(of_each)s AS position
    FROM generate_series(1, %(of_each)s) AS step
) AS picked
WHERE seen.starts IS NOT NULL
ORDER BY 1, 2

-- name: class_names
-- Classes of Objects.
SELECT DISTINCT ag_catalog.agtype_access_operator(
    VARIADIC ARRAY[properties, '"class_name"'::ag_catalog.agtype])
FROM {object}
