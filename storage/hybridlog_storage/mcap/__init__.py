"""Reads MCAP files of any origin, damaged ones too. Imports: segments."""
