"""Keeping a store whole: recovery, index, verification, repair, removal, import.

Segments and journals are the truth. Everything here holds what was made from them, the
catalog and the index, against them, and mends that, never the other way round. Before the
first step that destroys something, the intent is on the disk; whatever is interrupted, the
next opening of the store finishes.
"""
