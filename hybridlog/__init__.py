"""hybridlog records what a robot says and makes it answerable."""
