-- Each sink's checkpoint, in the database of its rows, so that both commit together. `sink` is
-- 'graph' or 'vectors'.

-- name: schema_owner
-- No row when there is no such schema, else its comment ('' for none), which marks ours.
SELECT coalesce(obj_description(oid, 'pg_namespace'), '') FROM pg_namespace WHERE nspname = 'mapfold'

-- name: create
CREATE SCHEMA mapfold;
COMMENT ON SCHEMA mapfold IS {made_by};
CREATE TABLE mapfold.checkpoint (
    sink         text PRIMARY KEY,
    log_id       text NOT NULL,
    fingerprint  text NOT NULL,           -- of the settings and the corrections
    settings     text NOT NULL,           -- canonical JSON, to say what differs
    next_offset  bigint NOT NULL CHECK (next_offset >= 0),
    last_event   text NOT NULL,           -- hash of the event at next_offset - 1, '' for none
    digest       text,                    -- of the whole map, when a rebuild computed it
    moved_at     timestamptz NOT NULL DEFAULT now(),
    heartbeat_at timestamptz,             -- when a tail last said that it lives
    known_at     bigint NOT NULL,         -- the corrections are those of the commands before it
    observed     text NOT NULL,           -- fingerprint of what the observations depend on
    maps         text                     -- key of the rows of mapfold.occupancy_map, null for none
);
CREATE TABLE mapfold.dead_letter (
    sink       text NOT NULL,
    log_offset bigint NOT NULL,
    key        text NOT NULL,
    run_id     text,                      -- when the payload still tells
    reason     text NOT NULL,
    parked_at  timestamptz NOT NULL DEFAULT now(),
    PRIMARY KEY (sink, log_offset)
);

-- name: load
SELECT log_id, fingerprint, settings, next_offset, last_event, digest, known_at, observed, maps
FROM mapfold.checkpoint WHERE sink = %(sink)s

-- name: rows_exist
SELECT to_regclass(%(table)s) IS NOT NULL

-- name: create_first
-- The first checkpoint, of one tail only if two start at once.
INSERT INTO mapfold.checkpoint
    (sink, log_id, fingerprint, settings, next_offset, last_event, known_at, observed)
VALUES (%(sink)s, %(log_id)s, %(fingerprint)s, %(settings)s, 0, '', %(known_at)s, %(observed)s)
ON CONFLICT (sink) DO NOTHING

-- name: advance
-- Compare-and-set: moves only from the offset, log, settings and corrections that the caller expects.
UPDATE mapfold.checkpoint
SET next_offset = %(next_offset)s, last_event = %(last_event)s, digest = NULL,
    fingerprint = %(fingerprint)s, known_at = %(known_at)s, observed = %(observed)s,
    maps = %(maps)s, moved_at = now(), heartbeat_at = now()
WHERE sink = %(sink)s AND next_offset = %(expected)s
  AND log_id = %(log_id)s AND fingerprint = %(expected_fingerprint)s
RETURNING next_offset

-- name: replace
-- A rebuild overwrites whatever was there.
INSERT INTO mapfold.checkpoint
    (sink, log_id, fingerprint, settings, next_offset, last_event, digest, known_at, observed, maps)
VALUES (%(sink)s, %(log_id)s, %(fingerprint)s, %(settings)s, %(next_offset)s, %(last_event)s,
        %(digest)s, %(known_at)s, %(observed)s, %(maps)s)
ON CONFLICT (sink) DO UPDATE
SET log_id = EXCLUDED.log_id, fingerprint = EXCLUDED.fingerprint, settings = EXCLUDED.settings,
    next_offset = EXCLUDED.next_offset, last_event = EXCLUDED.last_event,
    digest = EXCLUDED.digest, known_at = EXCLUDED.known_at, observed = EXCLUDED.observed,
    maps = EXCLUDED.maps, moved_at = now(), heartbeat_at = NULL

-- name: write_heartbeat
UPDATE mapfold.checkpoint SET heartbeat_at = now() WHERE sink = %(sink)s

-- name: name_session
SELECT set_config('application_name', %(name)s, false)

-- name: ages
SELECT extract(epoch FROM now() - moved_at)::float8, extract(epoch FROM now() - heartbeat_at)::float8
FROM mapfold.checkpoint WHERE sink = %(sink)s

-- name: park
INSERT INTO mapfold.dead_letter (sink, log_offset, key, run_id, reason)
VALUES (%(sink)s, %(log_offset)s, %(key)s, %(run_id)s, %(reason)s)
ON CONFLICT (sink, log_offset) DO UPDATE SET reason = EXCLUDED.reason

-- name: parked
SELECT log_offset, key, run_id, reason FROM mapfold.dead_letter
WHERE sink = %(sink)s ORDER BY log_offset

-- name: unpark
DELETE FROM mapfold.dead_letter WHERE sink = %(sink)s

-- name: lock
-- One writer per sink and database. The key is 'mapf' and the sink's number.
SELECT pg_try_advisory_lock(1835102310, %(number)s)

-- name: wait_for_lock
SELECT pg_advisory_xact_lock(1835102310, %(number)s)

-- name: lock_holder
SELECT a.pid, coalesce(nullif(a.application_name, ''), 'unknown')
FROM pg_locks l JOIN pg_stat_activity a USING (pid)
WHERE l.locktype = 'advisory' AND l.granted AND l.classid = 1835102310 AND l.objid = %(number)s
  AND l.database = (SELECT oid FROM pg_database WHERE datname = current_database())

-- name: may_create
-- Whether this role may make the shadows of a refold.
SELECT has_database_privilege(current_database(), 'CREATE')
