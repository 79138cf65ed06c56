"""Where messages go: one module a system, all behind `benchmarks.backends.base.Backend`."""
