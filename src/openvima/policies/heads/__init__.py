"""Action heads: from the decoder's action query to an action."""
