"""Fields of whole topics as columns: laid down beside the segments, kept in memory, asked."""
