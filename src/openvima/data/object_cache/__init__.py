"""The token cache: demonstrations as the crops and boxes that policies see, cut out once."""
