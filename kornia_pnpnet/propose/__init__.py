"""Proposers: modules that map a problem to poses to start from."""
