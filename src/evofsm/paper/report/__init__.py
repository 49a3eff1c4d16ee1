"""Reports: draw and print what studies and models hold; compute nothing."""
