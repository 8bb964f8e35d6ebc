"""The one door to Zenoh: sessions, what is declared on them, their configuration."""
