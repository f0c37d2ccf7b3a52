"""The bench: test cases, rivals and people that any model that completes motions can be judged by."""
