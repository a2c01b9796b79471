"""One module per file format: images and depth, arrays, meshes, clips. Each convention lives in one place."""
