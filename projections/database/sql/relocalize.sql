-- From crops to candidates: the nearest observations; of each its Object, the Object's Place, and the
-- Place of its keyframe. Graph ids follow from the observation's number (det_pk), so every step but the
-- search is a look-up of an indexed id. `{questions}` is a VALUES list of (crop, vector) bind parameters.
-- The last column of each half is its origin: log id, and fingerprint of settings and of what the
-- observations depend on (through JSON, as a table of an older version has no column for it).

-- name: near
-- The nearest `%(neighbours)s` observations of each crop, from the vectors' database.
WITH question (crop, wanted) AS ({questions})
SELECT question.crop, near.det_pk, near.det_id, near.run_id, 1 - near.distance, near.class_name,
       near.bbox, near.map_x, near.map_y, near.map_yaw, near.embedding_model,
       (SELECT log_id || ' ' || coalesce(to_jsonb(c) ->> 'observed', fingerprint)
        FROM mapfold.checkpoint c WHERE sink = 'vectors')
FROM question CROSS JOIN LATERAL (
    SELECT det_pk, det_id, run_id, class_name, bbox, map_x, map_y, map_yaw, embedding_model,
           embedding <=> question.wanted AS distance
    FROM public.detection_embeddings ORDER BY embedding <=> question.wanted LIMIT %(neighbours)s
) AS near

-- name: graph
-- Object, its Place and the keyframe's Place of each observation, from the graph's database.
SELECT seen.det_pk, thing.properties, its.id, its.properties, there.id, there.properties,
       (SELECT log_id || ' ' || coalesce(to_jsonb(c) ->> 'observed', fingerprint)
        FROM mapfold.checkpoint c WHERE sink = 'graph')
FROM unnest(%(det_pks)s::bigint[]) AS seen (det_pk)
LEFT JOIN {observes} AS observes
    ON observes.start_id = ag_catalog._graphid(%(observation)s, seen.det_pk)
LEFT JOIN {object} AS thing ON thing.id = observes.end_id
LEFT JOIN {located_in} AS located ON located.start_id = thing.id
LEFT JOIN {place} AS its ON its.id = located.end_id
LEFT JOIN {has_observation} AS has
    ON has.end_id = ag_catalog._graphid(%(observation)s, seen.det_pk)
LEFT JOIN {in_place} AS in_place ON in_place.start_id = has.start_id
LEFT JOIN {place} AS there ON there.id = in_place.end_id

-- name: near_and_graph
-- Both in one round trip and one snapshot, when they share a database.
WITH question (crop, wanted) AS ({questions})
SELECT question.crop, near.det_pk, near.det_id, near.run_id, 1 - near.distance, near.class_name,
       near.bbox, near.map_x, near.map_y, near.map_yaw, near.embedding_model,
       (SELECT log_id || ' ' || coalesce(to_jsonb(c) ->> 'observed', fingerprint)
        FROM mapfold.checkpoint c WHERE sink = 'vectors'),
       thing.properties, its.id, its.properties, there.id, there.properties,
       (SELECT log_id || ' ' || coalesce(to_jsonb(c) ->> 'observed', fingerprint)
        FROM mapfold.checkpoint c WHERE sink = 'graph')
FROM question CROSS JOIN LATERAL (
    SELECT det_pk, det_id, run_id, class_name, bbox, map_x, map_y, map_yaw, embedding_model,
           embedding <=> question.wanted AS distance
    FROM public.detection_embeddings ORDER BY embedding <=> question.wanted LIMIT %(neighbours)s
) AS near
LEFT JOIN {observes} AS observes
    ON observes.start_id = ag_catalog._graphid(%(observation)s, near.det_pk)
LEFT JOIN {object} AS thing ON thing.id = observes.end_id
LEFT JOIN {located_in} AS located ON located.start_id = thing.id
LEFT JOIN {place} AS its ON its.id = located.end_id
LEFT JOIN {has_observation} AS has
    ON has.end_id = ag_catalog._graphid(%(observation)s, near.det_pk)
LEFT JOIN {in_place} AS in_place ON in_place.start_id = has.start_id
LEFT JOIN {place} AS there ON there.id = in_place.end_id
