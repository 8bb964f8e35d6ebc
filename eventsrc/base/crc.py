"""CRC-32 by ISA-L, the checksum of MCAP records, commit marks and vectors.

ISA-L takes 0.1 to 0.3 µs for 9 kB, zlib 2 µs. An event is checksummed four times until it is
sealed, and each of its vectors twice in a fold. Where ISA-L is not installed zlib computes the same
numbers.
"""

try:
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]
