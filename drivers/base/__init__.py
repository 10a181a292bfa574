"""The base controller: telegrams, Modbus RTU, wheel odometry."""
