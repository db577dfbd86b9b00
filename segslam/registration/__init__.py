"""Two clouds to poses: Segregator without an initial guess, floor plans, and refinement. It does not judge them."""
