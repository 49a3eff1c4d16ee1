"""Many cars instead of one leader: objects, the pairs they make, and the worst of them."""
