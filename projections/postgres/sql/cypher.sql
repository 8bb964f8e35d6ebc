-- Row-level security that repeats the privileges of a graph's tables; cypher() does not check them.

-- name: add_policies
-- `{name}` is the table's name as a literal; as a regclass it keeps naming the table after a rename.
ALTER TABLE {table} ENABLE ROW LEVEL SECURITY;
CREATE POLICY mapfold_select ON {table} FOR SELECT USING (true);
CREATE POLICY mapfold_insert ON {table} FOR INSERT
    WITH CHECK (pg_catalog.has_table_privilege({name}::regclass, 'INSERT'));
CREATE POLICY mapfold_update ON {table} FOR UPDATE
    USING (pg_catalog.has_table_privilege({name}::regclass, 'UPDATE'));
CREATE POLICY mapfold_delete ON {table} FOR DELETE
    USING (pg_catalog.has_table_privilege({name}::regclass, 'DELETE'))

-- name: unwanted_writers
-- Roles that may use AGE and enter the graph, but lack UPDATE or DELETE on a table of it that has no
-- row-level security, or whose AGE does not enforce it.
SELECT DISTINCT r.rolname
FROM pg_class c CROSS JOIN pg_roles r
WHERE c.relnamespace = (SELECT oid FROM pg_namespace WHERE nspname = %(graph)s) AND c.relkind = 'r'
  AND NOT (c.relrowsecurity AND %(enforced)s)
  AND NOT r.rolsuper AND r.rolname NOT LIKE 'pg\_%%'
  AND has_schema_privilege(r.oid, 'ag_catalog', 'USAGE')
  AND has_schema_privilege(r.oid, c.relnamespace, 'USAGE')
  AND NOT (has_table_privilege(r.oid, c.oid, 'UPDATE')
           AND has_table_privilege(r.oid, c.oid, 'DELETE'))
ORDER BY 1

-- name: policies_apply
-- Whether row-level security applies to this session; COPY cannot write such a table.
SELECT row_security_active(%(table)s)
