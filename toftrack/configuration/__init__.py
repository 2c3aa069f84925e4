"""The configuration in conf/: composing it, and telling what is wrong with it."""
