"""Check logs: against the specification of MCAP, against docs/log.md, and with each other."""
