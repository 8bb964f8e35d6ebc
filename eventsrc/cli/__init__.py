"""The commands about the log: record, import, simulate, router, log …"""
