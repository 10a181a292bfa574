"""Maps that a fleet shares: what goes over the wire, the service that keeps them, the robot that fetches and offers."""
