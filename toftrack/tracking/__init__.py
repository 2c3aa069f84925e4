"""The tracker: a pure step from state to state, and what it is made of."""
