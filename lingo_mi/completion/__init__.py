"""Views that were not measured, rendered from a fitted cloud: the first of the two stages of CT."""
