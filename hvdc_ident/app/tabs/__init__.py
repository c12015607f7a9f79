"""The tabs of the workbench, one file each."""
