"""Brings what is derived of recordings up to date; evaluates triggers beside a live recorder.

Imports: columns, index, maintenance, query, record.
"""
