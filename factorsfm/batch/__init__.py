"""Films and folders of films: every shot found, reconstructed by several processes, and listed on one page."""
