"""Pictures of what the tracker sees and finds. Nothing here decides anything."""
