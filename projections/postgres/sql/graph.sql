-- The graph as AGE stores it: a schema with one table per label. `{graph}` and `{label}` are
-- identifiers; graph names passed to AGE's own functions are bind parameters.

-- name: insert_vertex
INSERT INTO {graph}.{label} (id, properties)
SELECT id::ag_catalog.graphid, properties::ag_catalog.agtype
FROM unnest(%s::text[], %s::text[]) AS r(id, properties)

-- name: upsert_vertex
INSERT INTO {graph}.{label} (id, properties)
SELECT id::ag_catalog.graphid, properties::ag_catalog.agtype
FROM unnest(%s::text[], %s::text[]) AS r(id, properties)
ON CONFLICT (id) DO UPDATE SET properties = EXCLUDED.properties

-- name: insert_edge
INSERT INTO {graph}.{label} (id, start_id, end_id, properties)
SELECT id::ag_catalog.graphid, start_id::ag_catalog.graphid, end_id::ag_catalog.graphid,
       properties::ag_catalog.agtype
FROM unnest(%s::text[], %s::text[], %s::text[], %s::text[]) AS r(id, start_id, end_id, properties)

-- name: upsert_edge
INSERT INTO {graph}.{label} (id, start_id, end_id, properties)
SELECT id::ag_catalog.graphid, start_id::ag_catalog.graphid, end_id::ag_catalog.graphid,
       properties::ag_catalog.agtype
FROM unnest(%s::text[], %s::text[], %s::text[], %s::text[]) AS r(id, start_id, end_id, properties)
ON CONFLICT (id) DO UPDATE
SET start_id = EXCLUDED.start_id, end_id = EXCLUDED.end_id, properties = EXCLUDED.properties

-- name: delete
DELETE FROM {graph}.{label}
WHERE id OPERATOR(ag_catalog.=) ANY (%s::text[]::ag_catalog.graphid[])

-- name: delete_from
-- Edges by where they start, for labels that have no index of their ids.
DELETE FROM {graph}.{label}
WHERE start_id OPERATOR(ag_catalog.=) ANY (%s::text[]::ag_catalog.graphid[])

-- name: copy_vertex
COPY {graph}.{label} (id, properties) FROM STDIN

-- name: copy_edge
COPY {graph}.{label} (id, start_id, end_id, properties) FROM STDIN

-- name: state
-- NULL when there is no such graph and no such schema, else whether AGE knows it, and its comment.
SELECT g.name IS NOT NULL, coalesce(obj_description(n.oid, 'pg_namespace'), '')
FROM pg_namespace n LEFT JOIN ag_catalog.ag_graph g ON g.namespace = n.oid::regnamespace
WHERE n.nspname = %(graph)s

-- name: is_empty
-- No vertex and no edge, and nothing in the schema besides the labels' tables.
SELECT NOT EXISTS (SELECT FROM {vertices}) AND NOT EXISTS (SELECT FROM {edges})
   AND NOT EXISTS (
       SELECT FROM pg_class c JOIN pg_namespace n ON n.oid = c.relnamespace
       WHERE n.nspname = %(graph)s AND c.relkind IN ('r', 'p', 'v', 'm', 'f')
         AND NOT EXISTS (SELECT FROM ag_catalog.ag_label l WHERE l.relation::oid = c.oid))

-- name: taken_names
SELECT nspname::text FROM pg_namespace WHERE nspname LIKE %(pattern)s

-- name: create_graph
SELECT ag_catalog.create_graph(%(graph)s::name)

-- name: mark
COMMENT ON SCHEMA {graph} IS 'mapfold: made from the log; rebuilt at will'

-- name: create_vlabel
SELECT ag_catalog.create_vlabel(%(graph)s, %(label)s)

-- name: create_elabel
SELECT ag_catalog.create_elabel(%(graph)s, %(label)s)

-- name: no_statistics
-- Nothing asks for statistics of whole property maps, and they take most of ANALYZE's time. Those of
-- the indexed keys are gathered nevertheless.
ALTER TABLE {table} ALTER COLUMN properties SET STATISTICS 0

-- name: label_ids
SELECT l.name, l.id FROM ag_catalog.ag_label l JOIN ag_catalog.ag_graph g ON g.graphid = l.graph
WHERE g.name = %(graph)s

-- name: rename_graph
SELECT ag_catalog.alter_graph(%(graph)s::name, 'RENAME', %(new_name)s::name)

-- name: drop_graph
SELECT ag_catalog.drop_graph(%(graph)s::name, true)

-- name: drop_named
-- The same without a parameter, for a statement that is only sent; the name is one of our constants.
SELECT ag_catalog.drop_graph({graph}, true)

-- name: indexed
-- Columns that an index already leads with, and whether it is unique: newer versions of AGE make
-- some indexes themselves.
SELECT c.relname, a.attname, bool_or(i.indisunique)
FROM pg_index i
JOIN pg_class c ON c.oid = i.indrelid
JOIN pg_attribute a ON a.attrelid = c.oid AND a.attnum = i.indkey[0]
WHERE c.relnamespace = (SELECT oid FROM pg_namespace WHERE nspname = %(graph)s)
GROUP BY 1, 2

-- name: index_unique
CREATE UNIQUE INDEX ON {graph}.{label} ({column})

-- name: index
CREATE INDEX ON {graph}.{label} ({column})

-- name: index_key
-- Serves `WHERE v.key = …`; the property's name is agtype text.
CREATE INDEX ON {graph}.{label}
(ag_catalog.agtype_access_operator(VARIADIC ARRAY[properties, {key}::ag_catalog.agtype]))

-- name: index_match
-- Serves `(v:Label {{key: …}})`.
CREATE INDEX ON {graph}.{label} USING gin (properties)

-- name: lock
LOCK TABLE {tables} IN ACCESS EXCLUSIVE MODE

-- name: sample
-- 6,000 rows of each table instead of 30,000
SET LOCAL default_statistics_target = 20

-- name: analyze
ANALYZE {graph}.{label}
