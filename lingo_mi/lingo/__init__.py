"""Section III of the paper: masks, the filter of all views, voxel scaling, mean pixel, loss scale."""
