"""Statistics and pictures of runs, and the page that shows them."""
