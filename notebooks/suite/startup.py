"""What a kernel runs first: imports make many objects and hardly any garbage; each notebook begins 0.6 s sooner."""

__import__("gc").set_threshold(50_000)
