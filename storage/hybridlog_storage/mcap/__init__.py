"""Reads MCAP files of any origin, damaged ones too."""
