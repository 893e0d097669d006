"""What is seen of a run in Rerun: one scene, live and in review."""
