"""What ``motionlab`` does at a command line, a module for each kind of command; ``commands.options`` lists them."""
