"""`ceilvod mapd`: a building's maps, offers of robots, and what a curator takes of them."""
