"""Figure 2: a publisher, a subscriber with a queue of ten for every topic, a backend."""
