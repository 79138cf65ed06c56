"""Answers other than counts: intervals and single messages."""
