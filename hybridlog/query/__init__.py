"""Questions: times, topics, predicates, plans."""
