"""The study of recognition on simulated people: the whole of `shapespace recognise study`."""
