-- Two group roles with the least they need. Run as the owner of the projection or as a superuser,
-- in each of its databases, once, after the first `mapfold replay`; a rebuild carries the grants
-- over to the tables it makes. Then make logins of your own members of them:
--     CREATE ROLE robot_ui LOGIN PASSWORD '…' IN ROLE mapfold_reader;
--     CREATE ROLE robot_tail LOGIN PASSWORD '…' IN ROLE mapfold_writer;

-- name: reader
-- Runs the queries, `mapfold relocalize`, `status` and `db check`; changes nothing.
DO $$ BEGIN
    IF NOT EXISTS (SELECT FROM pg_roles WHERE rolname = 'mapfold_reader') THEN
        CREATE ROLE mapfold_reader NOLOGIN;
    END IF;
END $$;
GRANT USAGE ON SCHEMA mapfold TO mapfold_reader;
GRANT SELECT ON ALL TABLES IN SCHEMA mapfold TO mapfold_reader;

-- name: writer
-- Runs `mapfold tail` on what a replay has made; creates and drops nothing.
DO $$ BEGIN
    IF NOT EXISTS (SELECT FROM pg_roles WHERE rolname = 'mapfold_writer') THEN
        CREATE ROLE mapfold_writer NOLOGIN IN ROLE mapfold_reader;
    END IF;
END $$;
GRANT INSERT, UPDATE, DELETE ON ALL TABLES IN SCHEMA mapfold TO mapfold_writer;

-- name: graph
-- Where the graph is. With USAGE on ag_catalog a role can call cypher(). Before version 1.7 AGE lets
-- that write whatever the role's privileges are, and later versions need the row-level security that
-- `mapfold replay` puts on the tables; so readers get it only where that holds.
GRANT USAGE ON SCHEMA ag_catalog TO mapfold_writer;
GRANT SELECT ON ag_catalog.ag_graph, ag_catalog.ag_label TO mapfold_writer;
DO $$
DECLARE
    version text := (SELECT extversion FROM pg_extension WHERE extname = 'age');
BEGIN
    IF string_to_array(substring(version FROM '^\d+\.\d+'), '.')::int2[] >= {first} AND NOT EXISTS (
        SELECT FROM pg_class WHERE relnamespace = 'semantic_map'::regnamespace
        AND relkind = 'r' AND NOT relrowsecurity
    ) THEN
        GRANT USAGE ON SCHEMA ag_catalog TO mapfold_reader;
        GRANT SELECT ON ag_catalog.ag_graph, ag_catalog.ag_label TO mapfold_reader;
    ELSE
        REVOKE USAGE ON SCHEMA ag_catalog FROM mapfold_reader;
        RAISE WARNING 'mapfold_reader may not use cypher(): Apache AGE % would let it write', version
            USING HINT = 'Run mapfold replay with AGE 1.7 or later, then this again.';
    END IF;
END $$;
GRANT USAGE ON SCHEMA semantic_map TO mapfold_reader;
GRANT SELECT ON ALL TABLES IN SCHEMA semantic_map TO mapfold_reader;
GRANT INSERT, UPDATE, DELETE ON ALL TABLES IN SCHEMA semantic_map TO mapfold_writer;

-- name: vectors
-- Where the table is.
GRANT SELECT ON public.detection_embeddings TO mapfold_reader;
GRANT INSERT ON public.detection_embeddings TO mapfold_writer;
