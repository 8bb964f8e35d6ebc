-- Tables in the schema of a graph that are not our labels'.

-- name: tables
-- Name, kind of relation, kind of label (NULL for none), whether this role may read it.
SELECT c.relname::text, c.relkind::text, l.kind::text, has_table_privilege(c.oid, 'SELECT')
FROM pg_class c LEFT JOIN ag_catalog.ag_label l ON l.relation = c.oid
WHERE c.relnamespace = (SELECT oid FROM pg_namespace WHERE nspname = %(graph)s)
  AND c.relkind IN ('r', 'p', 'v', 'm', 'f') AND NOT c.relname = ANY (%(ours)s)
ORDER BY 1
