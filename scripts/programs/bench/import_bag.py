"""Speed of importing a bag of ROS 2; see docs/ros.md for the numbers.

Makes a bag with a Detection2DArray, a message of embeddings and one of two transforms for each
picture, and times by processor time: the look through the bag, the loop that decodes messages and
makes envelopes, and the whole import with the log's writing.
"""

import argparse
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from eventsrc.log import LogWriter
from eventsrc.record.importers.bag_streams import BagOptions
from eventsrc.record.importers.ros_bags import RosBag
from eventsrc.record.importers.run import import_files
from tests.support.ros_bags import STORAGES, Drive, write_bag

GOAL = 5_000


def main() -> None:
    """Print a line for each kind of bag."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", type=int, default=10_000)
    parser.add_argument("--dim", type=int, default=512)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for storage in STORAGES:
            drive = Drive(asked.pictures, dim=asked.dim)
            bag = write_bag(Path(folder, storage, "drive"), drive.messages(), storage)
            look_s, loop_s = _loop(bag)
            before = time.process_time()
            with LogWriter(Path(folder, storage, "log")) as writer:
                report = import_files(writer, [str(bag)])
            whole_s = time.process_time() - before
            assert report.accepted == asked.pictures
            print(
                f"{storage}: {asked.pictures:,} pictures of {report.bags[0].messages:,} messages, "
                f"{asked.dim} dimensions: look {look_s:.2f} s; "
                f"decoding and assembling {asked.pictures / loop_s:,.0f}/s (goal {GOAL:,}); "
                f"whole import {asked.pictures / whole_s:,.0f}/s"
            )


def _loop(bag: Path) -> tuple[float, float]:
    """Processor seconds to the first envelope, and from there to the last."""
    with ExitStack() as files:
        start = time.process_time()
        messages = RosBag(bag, files, BagOptions()).messages()
        next(messages)
        first = time.process_time()
        for _ in messages:
            pass
        return first - start, time.process_time() - first


if __name__ == "__main__":
    main()
