"""Which scans are kept, their clouds, and clouds gathered from neighbouring keyframes."""
