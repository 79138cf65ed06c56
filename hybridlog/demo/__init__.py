"""The demo bag, one minute of a simulated robot, and the tour that asks it questions.

Imports: none.
"""
