-- The table of searchable detections (docs/projections.md). `{schema}` is public for what readers see
-- and mapfold for a rebuild's shadow; `{vector}` is the type, wherever the extension put it.

-- name: create
CREATE TABLE {schema}.detection_embeddings (
    det_pk          bigint PRIMARY KEY,            -- ordinal of the observation + 1
    run_id          text NOT NULL,
    det_id          text NOT NULL UNIQUE,          -- joins the graph's Observation
    keyframe_id     bigint NOT NULL,
    class_name      text NOT NULL,
    confidence      double precision NOT NULL,
    bbox            real[] NOT NULL,               -- x_min, y_min, x_max, y_max in pixels
    map_x           double precision,              -- metres; NULL when the robot had no pose
    map_y           double precision,
    map_yaw         double precision,              -- radians
    camera          double precision[],            -- field of view in degrees, width and height in pixels,
                                                   -- mounting in radians; NULL where none is stated
    embedding_model text,
    embedding       {vector}({dimension}) NOT NULL,  -- unit length
    ingested_at     timestamptz NOT NULL           -- when the event was logged
);
COMMENT ON TABLE {schema}.detection_embeddings IS 'mapfold: made from the log; rebuilt at will';

-- name: plain
-- In the row itself: 512 dimensions fit a page, and a search that reads every row stays out of TOAST.
-- So do the other columns: by default the server stores the bbox of any row above 2 kB in TOAST.
ALTER TABLE {schema}.detection_embeddings
    ALTER COLUMN embedding SET STORAGE PLAIN, SET (toast_tuple_target = 8160)

-- name: external
-- Too wide for a page; at least not compressed, which embeddings do not do.
ALTER TABLE {schema}.detection_embeddings
    ALTER COLUMN embedding SET STORAGE EXTERNAL, RESET (toast_tuple_target)

-- name: redimension
ALTER TABLE {schema}.detection_embeddings ALTER COLUMN embedding TYPE {vector}({dimension})

-- name: drop
DROP TABLE {schema}.detection_embeddings

-- name: lock
LOCK TABLE {schema}.detection_embeddings IN ACCESS EXCLUSIVE MODE

-- name: old_state
-- NULL when there is no such schema, else its comment.
SELECT coalesce(obj_description(oid, 'pg_namespace'), '') FROM pg_namespace WHERE nspname = 'mapfold_old'

-- name: put_aside
CREATE SCHEMA mapfold_old;
COMMENT ON SCHEMA mapfold_old IS 'mapfold: replaced, about to be dropped';
ALTER TABLE public.detection_embeddings SET SCHEMA mapfold_old

-- name: drop_old
DROP SCHEMA mapfold_old CASCADE

-- name: move
ALTER TABLE mapfold.detection_embeddings SET SCHEMA public

-- name: insert
INSERT INTO {schema}.detection_embeddings
    (det_pk, run_id, det_id, keyframe_id, class_name, confidence, bbox, map_x, map_y, map_yaw,
     camera, embedding_model, embedding, ingested_at)
SELECT det_pk, run_id, det_id, keyframe_id, class_name, confidence, bbox::real[], map_x, map_y,
       map_yaw, camera::float8[], embedding_model, embedding::{vector}, ingested_at
FROM unnest(%s::bigint[], %s::text[], %s::text[], %s::bigint[], %s::text[], %s::float8[], %s::text[],
            %s::float8[], %s::float8[], %s::float8[], %s::text[], %s::text[], %s::text[], %s::timestamptz[])
    AS r(det_pk, run_id, det_id, keyframe_id, class_name, confidence, bbox, map_x, map_y, map_yaw,
         camera, embedding_model, embedding, ingested_at)

-- name: state
-- NULL when there is no such table, else its comment and the declared dimension.
SELECT coalesce(obj_description(c.oid, 'pg_class'), ''), a.atttypmod
FROM pg_class c LEFT JOIN pg_attribute a ON a.attrelid = c.oid AND a.attname = 'embedding'
WHERE c.oid = to_regclass(%(table)s)

-- name: is_owner
SELECT pg_has_role(relowner, 'USAGE') FROM pg_class
WHERE oid = to_regclass('public.detection_embeddings')

-- name: count
SELECT count(*) FROM {schema}.detection_embeddings

-- name: sample
-- 6,000 rows instead of 30,000; a row is 2 kB
SET LOCAL default_statistics_target = 20

-- name: analyze
ANALYZE {schema}.detection_embeddings (det_pk, det_id, run_id)

-- name: hnsw
-- Of half precision: half the size, and what it finds is compared by the whole vectors. Crops of
-- look-alikes form tight clusters, which pgvector's default ef_construction of 64 leaves badly joined: a
-- search then misses whole clusters, however wide it is (docs/relocalization.md).
CREATE INDEX detection_embeddings_halves ON public.detection_embeddings
USING hnsw ((embedding::{halfvec}({dimension})) {opclass}) WITH (m = 16, ef_construction = 200)

-- name: extension_schema
SELECT nspname FROM pg_extension JOIN pg_namespace n ON n.oid = extnamespace WHERE extname = 'vector'

-- name: shape
SELECT (SELECT count(*) FROM public.detection_embeddings), a.atttypmod
FROM pg_attribute a
WHERE a.attrelid = 'public.detection_embeddings'::regclass AND a.attname = 'embedding'

-- name: has_hnsw
-- Whether the readers' table has the index for vector search.
SELECT EXISTS (
    SELECT 1 FROM pg_index i JOIN pg_class c ON c.oid = i.indexrelid
    JOIN pg_am a ON a.oid = c.relam
    WHERE i.indrelid = to_regclass('public.detection_embeddings') AND a.amname = 'hnsw'
)

-- name: mean_vectors
-- The mean vector of the observations of each thing, and their space.
SELECT given.thing, avg(seen.embedding)::real[], min(seen.embedding_model)
FROM unnest(%(det_pks)s::bigint[], %(things)s::bigint[]) AS given (det_pk, thing)
JOIN public.detection_embeddings AS seen USING (det_pk)
GROUP BY given.thing ORDER BY given.thing
