"""A program that publishes as several robots at once, on Zenoh alone: any 1.x of it will do.

    python many_publishers.py ENDPOINT KEY PUBLISHERS COUNT PER_SECOND STAMPS

Each publisher has a session of its own, is reliable and blocks, and sends the keyframes 0 to
COUNT - 1 of the run ``run-<its number>``, PER_SECOND of them a second. STAMPS says which timestamps
the messages bear: ``none`` of their own, all ``equal``, or each ``backwards`` from the one before.
"""

import json
import sys
import threading
import time

import zenoh


def open_session(endpoint: str) -> zenoh.Session:
    """A client of the router at ``endpoint`` that connects to no other peer."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    return zenoh.open(config)


def confirm(session: zenoh.Session) -> None:
    """Return when the router has read everything this session sent before."""
    for _ in session.get(f"confirm/{session.info.zid()}", timeout=30.0):
        pass


def stamps_of(session: zenoh.Session, kind: str, count: int) -> list[zenoh.Timestamp | None]:
    """The timestamps of ``count`` messages."""
    if kind == "none":
        return [None] * count
    if kind == "equal":
        return [session.new_timestamp()] * count
    return [session.new_timestamp() for _ in range(count)][::-1]


def publish(
    endpoint: str, key: str, run_id: str, count: int, per_second: float, stamps: str
) -> None:
    """The life of one publisher."""
    with open_session(endpoint) as session:
        publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        confirm(session)
        begin, pace = time.monotonic(), threading.Event()
        for k, stamp in enumerate(stamps_of(session, stamps, count)):
            pace.wait(max(0.0, begin + k / per_second - time.monotonic()))
            envelope = {"run_id": run_id, "keyframe_id": k, "timestamp": 1.0, "detections": []}
            payload = json.dumps(envelope).encode()
            if stamp is None:
                publisher.put(payload)
            else:
                session.put(
                    key,
                    payload,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                    timestamp=stamp,
                )
        confirm(session)


def main() -> None:
    """Publish from all of them at once."""
    endpoint, key, publishers, count, per_second, stamps = sys.argv[1:]
    threads = [
        threading.Thread(
            target=publish,
            args=(endpoint, key, f"run-{number}", int(count), float(per_second), stamps),
        )
        for number in range(int(publishers))
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


if __name__ == "__main__":
    main()
