"""The benchmark of huang2024, Tables 1 and 2: beetle antennae searches against other swarms."""
