"""The policies and the parts that they share."""
