"""Questions about messages: times, topics, predicates and plans.

Imports: across, arrays, columns, frames, index, live, record, schema, tf.
"""
