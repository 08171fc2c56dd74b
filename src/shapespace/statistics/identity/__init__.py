"""Who is it: scores between scans of people, and how well they tell one person from another."""
