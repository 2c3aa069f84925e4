"""The SwissRanger SR-3000 over USB, and its emulator."""
