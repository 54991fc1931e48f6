"""A ledger that several robots share: its configuration, the replica on this machine, and episodes that wait."""
