"""The hot paths of hybridlog, one at a time, against an earlier revision of the source.

The `bench_*` modules know nothing of revisions: they measure the hybridlog that they can
import, on inputs that are made beforehand. `command` runs them on two sources in turn.
"""
