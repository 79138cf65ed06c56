"""Questions about messages: times, topics, predicates and plans."""
