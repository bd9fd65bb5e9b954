"""Features, global descriptors and shortlists of other programs: read, checked, and written back."""
