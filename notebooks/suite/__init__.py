"""What every notebook begins with (``notebook``), and the machinery that runs them all; both need a checkout."""
