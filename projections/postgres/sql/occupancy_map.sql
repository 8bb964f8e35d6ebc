-- The occupancy map in force on each floor that has one, beside the checkpoints in the database of the
-- graph. Written in the transactions of the graph's rows. `png` and `digest` are as in `mapfold/map` events.

-- name: exists
SELECT to_regclass('mapfold.occupancy_map') IS NOT NULL

-- name: create
CREATE TABLE mapfold.occupancy_map (
    log_offset bigint PRIMARY KEY,         -- of the event that gave it
    floor      text UNIQUE,                -- null for poses whose floor has no name
    map_id     text,
    source     text NOT NULL,              -- the file or key that it came from
    resolution float8 NOT NULL,            -- metres, the side of a cell
    origin_x   float8 NOT NULL,            -- metres and radians: the outer corner of the first cell
    origin_y   float8 NOT NULL,
    origin_yaw float8 NOT NULL,
    width      integer NOT NULL,           -- cells
    height     integer NOT NULL,
    png        bytea NOT NULL,             -- 8-bit grey: 0 free, 100 occupied, 255 unknown
    digest     text NOT NULL               -- SHA-256 of the grid and where it lies
)

-- name: clear
DELETE FROM mapfold.occupancy_map

-- name: insert
INSERT INTO mapfold.occupancy_map (log_offset, floor, map_id, source, resolution, origin_x, origin_y,
                                   origin_yaw, width, height, png, digest)
VALUES (%s, %s, %s, %s, %s, %s, %s, %s, %s, %s, %s, %s)

-- name: rows
SELECT log_offset, floor, map_id, source, resolution, origin_x, origin_y, origin_yaw, width, height, png,
       digest
FROM mapfold.occupancy_map ORDER BY log_offset

-- name: with_key
-- All rows with the key that the checkpoint has for them; one row of nulls if there is no map.
SELECT c.maps, m.log_offset, m.floor, m.map_id, m.source, m.resolution, m.origin_x,
       m.origin_y, m.origin_yaw, m.width, m.height, m.png, m.digest
FROM mapfold.checkpoint c LEFT JOIN mapfold.occupancy_map m ON true
WHERE c.sink = 'graph' ORDER BY m.log_offset
