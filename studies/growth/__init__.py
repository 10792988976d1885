"""Growth of cost with pixels, views, Gaussians and voxels: CPU time and peak memory of every stage."""
