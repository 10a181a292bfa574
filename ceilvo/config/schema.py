"""Every key of config.yaml: type, default, range, unit (in the name) and the reason in one line.

The dataclasses here are the schema; ceilvo.config.reader reads files against it, ceilvo.config.rendering writes them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from ceilvo.config.sections.beacons import Beacons
from ceilvo.config.sections.fleet import Fleet, Mapd
from ceilvo.config.sections.interop import Ros2, Vda5050, Web
from ceilvo.config.sections.keys import key
from ceilvo.config.sections.senses import Senses


@dataclass(frozen=True)
class Robot:
    name: str = key("robot1", "one Zenoh key segment; distinguishes robots of a fleet")


PIXEL_FORMATS = (
    *("GREY", "YUYV", "UYVY", "NV12", "MJPG", "Y10", "Y12", "Y16", "Y10P", "Y12P"),
    *("RGGB", "GRBG", "GBRG", "BA81", "RG10", "BA10", "GB10", "BG10", "RG12", "BA12", "GB12", "BG12"),
    *("RG16", "GR16", "GB16", "BYR2", "pRAA", "pgAA", "pGAA", "pBAA", "pRCC", "pgCC", "pGCC", "pBCC"),
)
"""That a camera may be asked for, V4L2's four characters without trailing blanks, the one to prefer first."""


@dataclass(frozen=True)
class Camera:
    source: str = key("v4l2", "where frames come from", choices=("v4l2", "folder", "video"))
    device: str = key("/dev/video0", "device node; prefer the stable name under /dev/v4l/by-id/")
    path: str = key("", "image folder or video file, for source folder or video")
    pixel_format: str = key("YUYV", "what to ask of the device; GREY is cheapest", choices=PIXEL_FORMATS)
    width_px: int = key(640, "must equal the calibration's", low=64, high=7680)
    height_px: int = key(480, "must equal the calibration's", low=64, high=4320)
    rate_hz: float = key(30.0, "frames per second to ask for", low=1.0, high=240.0)
    exposure_us: float | None = key(
        None,
        "fixed exposure; null leaves auto exposure on (multiples of 10000 us avoid 50 Hz flicker)",
        low=10.0,
        high=1e6,
    )
    gain: float | None = key(None, "fixed gain in the driver's units; null leaves it alone", low=0.0, high=1e6)
    read_timeout_s: float = key(1.0, "a camera silent for longer is lost and reopened", low=0.1, high=10.0)
    reopen_min_s: float = key(0.2, "first wait before reopening a lost camera", low=0.05, high=60.0)
    reopen_max_s: float = key(1.0, "longest wait between attempts to reopen", low=0.1, high=300.0)
    refuse_repeats: bool = key(
        True, "a picture that equals the one before, byte for byte, is not new: a frozen camera; false for test feeds"
    )


@dataclass(frozen=True)
class CalibrationFile:
    file: str = key("calibration.yaml", "written by calib; relative to this file's folder")


_PX_PER_DEG = 7.1506
"""Keys of features were pixels up to ceilvo 0.1: of a camera of 409.7 px, for which their defaults had been chosen."""


@dataclass(frozen=True)
class Features:
    smoothing_px: int = key(
        3, "Gaussian window before edge detection, odd; 5 for jagged or binary images", low=3, high=9
    )
    canny_sigmas: float = key(
        4.0, "upper Canny threshold in standard deviations of the image gradient", low=1.0, high=20.0
    )
    canny_floor: float = key(12.0, "smallest upper Canny threshold", low=1.0, high=255.0)
    canny_low_ratio: float = key(0.45, "lower over upper threshold", low=0.1, high=1.0)
    max_edge_share: float = key(
        0.15,
        "edge points used, as a share of the pixels; more are sampled evenly: bounds the time",
        low=0.001,
        high=1.0,
    )
    direction_gate_deg: float = key(
        8.0, "edge points further off the dominant directions are not lines", low=1.0, high=20.0
    )
    hough_angle_deg: float = key(1.0, "Hough search to either side of the dominant direction", low=0.2, high=5.0)
    hough_bin_deg: float = key(
        0.2797, "width of a Hough offset bin", low=0.07, high=1.4, was=("hough_bin_px", _PX_PER_DEG)
    )
    min_line_deg: float = key(
        4.195, "edges that make a line are so long together", low=1.1, high=140.0, was=("min_line_points", _PX_PER_DEG)
    )
    max_lines: int = key(60, "strongest lines kept per axis", low=4, high=500)
    groove_deg: float = key(
        0.979,
        "a falling and a rising edge closer than this are one groove",
        low=0.13,
        high=4.2,
        was=("groove_px", _PX_PER_DEG),
    )
    crossing_reach_deg: float = key(
        1.678,
        "both lines need edge points this near to their crossing",
        low=0.27,
        high=14.0,
        was=("crossing_reach_px", _PX_PER_DEG),
    )
    full_every: int = key(
        10, "look at the whole frame every so many frames, else where lines are expected; 1 = always", low=1, high=1000
    )
    max_view_deg: float = key(70.0, "rays further off the vertical are ignored", low=20.0, high=85.0)
    estimate_tilt: bool = key(True, "estimate the robot's roll and pitch from the convergence of parallel lines")
    faint_lines: bool = key(
        True, "where edges give few crossings, look for lines too faint for single pixels; false is the paper's way"
    )
    points: bool = key(
        True, "where lines cross at few places, look for lamps, corners and spots; false is the paper's way"
    )
    tilt_prior_deg: float = key(1.0, "standard deviation of the robot's tilt beforehand", low=0.01, high=10.0)


@dataclass(frozen=True)
class Odometry:
    match_radius_m: float = key(0.15, "a feature may be this far from its prediction", low=0.01, high=1.0)
    ransac_px: float = key(2.0, "homography RANSAC threshold", low=0.2, high=20.0)
    residual_sigmas: float = key(4.0, "residual rejection of eq. 16 in standard deviations", low=1.0, high=10.0)
    residual_max_m: float = key(0.010, "residual rejection of eq. 16, upper bound", low=0.001, high=0.2)
    min_inliers: int = key(3, "fewer correspondences are a failure", low=2, high=50)
    heading_gate_rad: float = key(
        0.01, "disagreement with the dominant direction that is a failure", low=0.001, high=0.2
    )
    max_speed_mps: float = key(2.0, "faster motion is a failure", low=0.05, high=10.0)
    max_accel_mps2: float = key(
        10.0, "a step that the last twist contradicts by more than this acceleration is a failure", low=0.1, high=1000.0
    )
    max_turn_radps: float = key(3.5, "faster turning is a failure", low=0.05, high=20.0)
    max_turn_accel_radps2: float = key(
        40.0,
        "a turn that the last twist contradicts by more than this angular acceleration is a failure",
        low=0.1,
        high=1000.0,
    )
    noise_xy_m: float = key(
        0.00002, "standard deviation added to every step along x and y for what the fit does not see", low=0.0, high=0.1
    )
    noise_theta_rad: float = key(0.000005, "standard deviation added to every step in heading", low=0.0, high=0.1)
    coast_accel_mps2: float = key(
        0.8,
        "standard deviation of a slow robot's acceleration while vision is out: covariance grows with it",
        low=0.01,
        high=10.0,
    )
    coast_turn_radps2: float = key(1.0, "the same of its angular acceleration", low=0.01, high=20.0)
    max_delay_s: float = key(
        0.2,
        "pictures later than the wheels by more are an error; shorter delays are found while driving and taken out",
        low=0.05,
        high=0.5,
    )


OLD_METHODS = {"pfcf": "joint"}
"""What filter.method was called up to ceilvo 0.1, and what that is now."""


@dataclass(frozen=True)
class Filter:
    method: str = key(
        "joint",
        "joint = one Gaussian of pose and map, hypotheses of slip; pfcf_paper = particles, eqs. 21-25 to the letter; "
        "pf = FastSLAM 1.0; ukf = unscented Kalman filter",
        choices=("joint", "pfcf_paper", "pf", "ukf"),
        renamed=OLD_METHODS,
    )
    particles: int = key(100, "number of pose hypotheses", low=10, high=100000)
    fit_degree: int = key(4, "pfcf_paper: degree n of the curve of eq. 21", low=1, high=16)
    gate_chi2: float = key(9.0, "joint, ukf: squared normalised innovation that is an outlier", low=2.0, high=1e3)
    ukf_gate: bool = key(True, "ukf: refuse outliers")
    slip_per_m: float = key(0.02, "joint: how often wheels start to slip per metre; 0 = never", low=0.0, high=10.0)
    slip_share: float = key(0.8, "joint: how much of the reported way a slip may swallow", low=0.0, high=1.0)
    lost_updates: int = key(
        8, "benches of joint only: updates refused in a row that start a search on the map", low=2, high=1000
    )
    resample_ess_ratio: float = key(
        0.5, "resample when ESS falls below this share of the particles", low=0.05, high=1.0
    )
    process_xy_m: float = key(
        0.0003, "spread of the particles by every frame: odometry's slow drift is no white noise", low=0.0, high=0.1
    )
    process_theta_rad: float = key(0.0001, "the same in heading", low=0.0, high=0.1)
    outlier_floor: float = key(0.02, "share of observations that may be outliers", low=0.0, high=0.5)
    feature_independence: float = key(
        0.5,
        "K features of one frame count as K to this power: 1 = independent, 0.5 = crossings of a grid of lines",
        low=0.0,
        high=1.0,
    )
    update_travel_m: float = key(
        0.05,
        "update with landmarks after this much travel: nearby frames share their errors",
        low=0.0,
        high=1.0,
    )
    update_turn_deg: float = key(3.0, "or after this much turning", low=0.0, high=90.0)
    update_period_s: float = key(1.0, "or after this much time", low=0.0, high=60.0)
    association_gate_m: float = key(0.20, "largest distance of a feature from its landmark", low=0.01, high=1.0)
    birth_sightings: int = key(3, "sightings that confirm a landmark", low=1, high=20)
    max_landmarks: int = key(
        200_000,
        "landmarks in the map; in a full one nothing new is learnt, and the log says so",
        low=10,
        high=2_000_000,
    )
    initial_pose_x_m: float = key(0.0, "pose in map at start", low=-1e5, high=1e5)
    initial_pose_y_m: float = key(0.0, "pose in map at start", low=-1e5, high=1e5)
    initial_pose_theta_deg: float = key(0.0, "pose in map at start", low=-360.0, high=360.0)


@dataclass(frozen=True)
class States:
    dead_reckoning_s: float = key(0.15, "without vision for longer is DEAD_RECKONING", low=0.0, high=10.0)
    tracking_frames: int = key(5, "good frames in a row before TRACKING", low=1, high=100)
    degraded_inliers: int = key(4, "fewer inliers that lie apart is DEGRADED", low=2, high=100)
    degraded_sigma_m: float = key(0.05, "larger position sigma is DEGRADED", low=0.001, high=10.0)
    degraded_heading_deg: float = key(1.0, "larger heading sigma is DEGRADED", low=0.01, high=90.0)
    degraded_within_m: float = key(
        0.3, "DEGRADED promises the position within this, 3 sigma; else it is DEAD_RECKONING", low=0.003, high=30.0
    )
    degraded_within_deg: float = key(5.0, "the same for the heading", low=0.03, high=180.0)
    lost_sigma_m: float = key(0.50, "larger position sigma is LOST", low=0.01, high=100.0)
    nis_high: float = key(3.0, "mean NIS per degree of freedom above this is DEGRADED", low=1.0, high=100.0)
    nis_lost: float = key(
        12.0, "mean NIS per degree of freedom above this for nis_frames updates is LOST", low=1.0, high=1000.0
    )
    false_place_rate: float = key(
        1e-4, "chance at most that a place which is called good is a wrong one", low=1e-9, high=0.1
    )
    nis_frames: int = key(10, "updates that must agree before NIS changes the state", low=1, high=1000)


@dataclass(frozen=True)
class Base:
    enabled: bool = key(True, "talk to a base controller")
    port: str = key("/dev/ttyUSB0", "serial device; prefer the stable name under /dev/serial/by-id/")
    baud: int = key(115200, "line rate", low=1200, high=4000000)
    parity: str = key("E", "Modbus RTU's default is even", choices=("N", "E", "O"))
    unit_id: int = key(1, "Modbus address of the base", low=1, high=247)
    rate_hz: float = key(20.0, "poses per second on the wire", low=0.1, high=200.0)
    timeout_s: float = key(0.10, "a base that does not answer within this has failed once", low=0.005, high=5.0)
    turnaround_ms: float = key(3.0, "time the base takes to answer, for the rate check", low=0.0, high=1000.0)
    function: str = key(
        "fc23", "fc23 = one transaction; fc16_fc04 = for bases without FC23", choices=("fc23", "fc16_fc04")
    )
    protocol: int = key(1, "protocol version that the base speaks; 2 brings gyro and accelerations", low=1, high=2)
    predict: bool = key(
        False, "protocol 2: send the pose moved on to the moment of sending, which a base that steers at 50 Hz needs"
    )
    use_wheels: bool = key(True, "use the base's wheel odometry to predict and to bridge")
    stale_s: float = key(
        0.5, "an older estimate is told to the base as DEAD_RECKONING at best, whatever it was", low=0.05, high=60.0
    )
    reconnect_max_s: float = key(1.0, "longest wait between attempts to reopen the port", low=0.05, high=60.0)


@dataclass(frozen=True)
class Zenoh:
    enabled: bool = key(True, "publish on Zenoh")
    wire: tuple[str, ...] = key(
        ["json"],
        "any of json, rmw_zenoh (ROS 2 with rmw_zenoh) and ros2dds (zenoh-bridge-ros2dds)",
        choices=("json", "rmw_zenoh", "ros2dds"),
    )
    prefix: str = key("ceilvo", "first part of every key")
    mode: str = key("peer", "peer needs no router", choices=("peer", "client"))
    listen: tuple[str, ...] = key(["tcp/127.0.0.1:0"], "endpoints to listen on; loopback unless you say otherwise")
    connect: tuple[str, ...] = key([], "endpoints to connect to, for example a router")
    multicast: bool = key(
        True,
        "be found by multicast on loopback; a client without zenoh.connect: use the router of this computer",
    )
    config_file: str = key("", "a Zenoh configuration file (JSON5) passed through whole: TLS, access control")
    command_token_file: str = key(
        "", "a file with the owner's token, which every command must bring then; needed where others can reach the bus"
    )
    allow_same_name: bool = key(False, "start though another daemon behind zenoh.connect has the same robot.name")
    predict_ms: float | None = key(
        None, "pose messages are moved on to so long after they are sent; null = of the picture", low=0.0, high=500.0
    )
    health_period_s: float = key(1.0, "period of the health message", low=0.1, high=60.0)
    landmarks_period_s: float = key(1.0, "shortest period of the landmarks message", low=0.1, high=60.0)
    particles_period_s: float = key(0.2, "shortest period of the particles message", low=0.02, high=60.0)
    image_period_s: float = key(0.5, "shortest period of the image message", low=0.05, high=60.0)


@dataclass(frozen=True)
class Service:
    state_dir: str = key("", "where map and last pose are kept; empty = $STATE_DIRECTORY, else nothing is kept")
    state_period_s: float = key(
        10.0, "period of saving map and last pose; the pose also once the robot has stopped", low=0.5, high=3600.0
    )
    map_generations: int = key(5, "maps of earlier runs that are kept, as map.db.1 and so on", low=0, high=100)
    floor: str = key("", "which floor of the map the robot is on; empty = the only one, or the first of several")
    seed: int = key(1, "seed of all randomness", low=0, high=2**31 - 1)
    log_level: str = key("info", "least severe message logged", choices=("debug", "info", "warning", "error"))
    opencv_threads: int = key(1, "threads OpenCV may use", low=1, high=64)


@dataclass(frozen=True)
class Recorder:
    enabled: bool = key(True, "flight recorder: the last minutes on disk, kept on a fault; needs a state directory")
    minutes: float = key(5.0, "how much of the past is there", low=0.1, high=1440.0)
    ring_bytes: int = key(200_000_000, "room for it; whichever of the two is less", low=20_000_000, high=10**12)
    kept_bytes: int = key(500_000_000, "room for what faults made it keep; the oldest go", low=20_000_000, high=10**12)
    reserve_bytes: int = key(100_000_000, "recording stops when less than this is left on the disk", low=0, high=10**12)
    after_fault_s: float = key(10.0, "how long to go on before a fault's recording is closed", low=0.0, high=600.0)
    frames: str = key(
        "jpeg",
        "lossless = every frame, replays bit for bit from its pixels on, 8 MB/s; jpeg = to look at",
        choices=("lossless", "jpeg", "none"),
    )
    features: bool = key(
        True, "unless frames are lossless: what vision found in each, from which the rest replays bit for bit"
    )
    jpeg_rate_hz: float = key(5.0, "pictures per second with frames jpeg", low=0.1, high=240.0)


@dataclass(frozen=True)
class Config:
    """One field a section of config.yaml."""

    robot: Robot = field(default_factory=Robot)
    camera: Camera = field(default_factory=Camera)
    calibration: CalibrationFile = field(default_factory=CalibrationFile)
    features: Features = field(default_factory=Features)
    odometry: Odometry = field(default_factory=Odometry)
    filter: Filter = field(default_factory=Filter)
    senses: Senses = field(default_factory=Senses)
    states: States = field(default_factory=States)
    base: Base = field(default_factory=Base)
    beacons: Beacons = field(default_factory=Beacons)
    zenoh: Zenoh = field(default_factory=Zenoh)
    ros2: Ros2 = field(default_factory=Ros2)
    vda5050: Vda5050 = field(default_factory=Vda5050)
    web: Web = field(default_factory=Web)
    service: Service = field(default_factory=Service)
    recorder: Recorder = field(default_factory=Recorder)
    fleet: Fleet = field(default_factory=Fleet)
    mapd: Mapd = field(default_factory=Mapd)


SECTIONS: tuple[str, ...] = tuple(f.name for f in fields(Config))
