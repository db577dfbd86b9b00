"""Any number of drives in one frame: each mapped on its own, related to the others, and joined where they overlap."""
