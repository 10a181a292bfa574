"""VDA 5050 by MQTT: the part of it that a localisation knows."""
