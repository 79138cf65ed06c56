"""Training sets for robot learning, from recordings."""
