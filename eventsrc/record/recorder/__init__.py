"""Record from Zenoh to a log: Zenoh's channel → bounded queue → one writer thread."""
