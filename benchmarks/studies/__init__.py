"""The three studies: which cases, how often, and what is left to do."""
