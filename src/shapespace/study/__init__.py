"""Recognition measured on scans of one's own: `shapespace recognise study`."""
