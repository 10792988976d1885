"""Many independent jobs: one by one in this process (`in_process`), or on the workers of a Dask cluster (`cluster`)."""
