"""What section III of the paper says: masks, the filter of all views, voxel scaling, mean pixel, loss scale."""
