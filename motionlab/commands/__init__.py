"""What ``motionlab`` does at a command line, a module for each kind of command; ``motionlab.__main__`` lists them."""
