"""Maps from laser scans and odometry. A library: it knows no bus and no clock."""
