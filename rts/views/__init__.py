"""Several views of a scene, in one call: sampled and splatted side by side in one picture."""
