"""The simulated robot that logs are made from."""
