"""What commissioning is worth, measured over many simulated rigs."""
