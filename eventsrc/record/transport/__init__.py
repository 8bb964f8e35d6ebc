"""Zenoh: sessions, their configuration, and what is declared on them."""
