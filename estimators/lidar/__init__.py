"""Motion from laser scans."""
