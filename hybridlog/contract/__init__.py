"""Contracts: rules that a good recording keeps, and the verdict on a recording."""
