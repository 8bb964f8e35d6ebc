"""Where a robot is: re-localisation, its evaluation, and the constants of a map."""
