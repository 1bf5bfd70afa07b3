"""Files that appear whole or not at all, texts of strangers read with limits, one run per folder."""
