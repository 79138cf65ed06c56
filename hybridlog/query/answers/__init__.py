"""What a question is answered with besides a count: intervals, single messages."""
