"""An imported MCAP file of another program: events in a log, or one clear error."""

import random
import shutil
from collections.abc import Sequence
from io import BytesIO

from mcap.writer import CompressionType, Writer

from eventsrc.base.errors import MapfoldError
from eventsrc.log import NEVER, LogReader, LogWriter
from eventsrc.record.importers.run import import_files
from scripts.programs.fuzz.mcap_mutation import mutate_mcap
from scripts.programs.fuzz.scratch import scratch
from scripts.programs.fuzz.target import Target, check_message
from tests.support.envelopes import envelope, payload


class McapTarget(Target):
    """The bytes of the file."""

    def seeds(self) -> Sequence[bytes]:
        """With and without chunks."""
        return [
            _file(use_chunking=False),
            *(_file(compression=kind) for kind in CompressionType),
        ]

    def mutate(self, data: bytes, rng: random.Random) -> bytes:
        """One record, below the checksums."""
        return mutate_mcap(data, rng)

    def check(self, data: bytes) -> None:
        """What was imported can be read, and is as much as was said."""
        file, log = scratch() / "other.mcap", scratch() / "imported"
        file.write_bytes(data)
        shutil.rmtree(log, ignore_errors=True)
        try:
            with LogWriter(log, fsync=NEVER) as writer:
                import_files(writer, [str(file)])
        except MapfoldError as error:
            check_message(error)
        with LogReader(log) as reader:
            assert len([*reader.read()]) == reader.next_offset


def _file(**options: object) -> bytes:
    out = BytesIO()
    writer = Writer(out, **options)  # type: ignore[arg-type]
    writer.start()
    schema = writer.register_schema("envelope", "jsonschema", b"{}")
    for number, key in enumerate(("tb/detections", "camera", "mapfold/loss")):
        encoding = "cdr" if key == "camera" else "json"
        channel = writer.register_channel(key, encoding, schema if number else 0)
        for k in range(3):
            data = payload(envelope(k))
            writer.add_message(channel, log_time=k, publish_time=k, sequence=k, data=data)
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()
