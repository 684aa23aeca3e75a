"""Whether images are the same: gates, goldens, and pages to look at."""
