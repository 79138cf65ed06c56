"""Pictures of what a store holds, as numbers and bytes: no server, page or terminal here.

Imports: arrays, frames, query, schema, tf.
"""
