"""Questions across topics: joins by time and sets of messages.

Imports: frames, query, schema, tf.
"""
