"""The live page: a run while it is driven, or one that was recorded, in the browser."""
