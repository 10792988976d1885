"""Line integrals and their derivatives on the device: Gaussians, grids and meshes."""
