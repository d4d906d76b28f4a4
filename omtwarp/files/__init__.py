"""Files: atomic writing, reading with limits, and what an interruption leaves of them."""
