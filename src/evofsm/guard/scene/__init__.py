"""A judge of scenes, in which failure is to meet an object: see `risk.SceneRisk`."""
