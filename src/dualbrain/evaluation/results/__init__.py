"""Result rows of episodes and their Parquet file."""
