"""Body and object refined together over all frames (equation 6)."""
