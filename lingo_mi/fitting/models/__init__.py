"""Models: how the parameters of a method become images and volumes."""
