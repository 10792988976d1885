"""The parts of a method: frozen dataclasses of options, each with its sources."""
