"""How the built-in creatures are made: skeletons, skin, meshes, poses."""
