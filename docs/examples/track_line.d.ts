// Made of docs/track_line.schema.json by docs/make_types.py.

/** x, y, z; null where there is none. */
export type Vector = [number | null, number | null, number | null];

/** x, y, z, w; null where there is none. */
export type Quaternion = [number | null, number | null, number | null, number | null];

/** What is said of a frame. */
export interface Frame {
  /** Number of the input frame. */
  index: number;
  /** Its time, seconds. */
  timestamp_s: number;
  /** Wall seconds from the raw frame to the estimate. */
  compute_s: number | null;
  /** Width and height of the image, pixels, which landmarks are in parts of; null where nobody says. */
  image_size_px: [number, number] | null;
}

/** What is said of a hand. */
export interface Hand {
  /** What the tracker does: tracking, or why not. */
  state_name: "tracking" | "searching" | "other hand" | "hidden" | "out of view" | "initialising" | "lost" | "recovering";
  /** Not to be used: no hand, or one of which too much is likely wrong. Of single joints: joint_ok. */
  lost: boolean;
  /** Probability that every joint is within 40 mm. */
  confidence: number | null;
  /** How far the pose lies off the pose space, rad rms. */
  outside_rad: number | null;
  /** Whose hand it is; empty where nobody says. */
  side: "right" | "left" | "";
  /** How sure the side is; 1 where it was given. */
  side_probability: number | null;
  /** How well the estimate explains the image. */
  score: number | null;
  /** Metres, camera axes (x right, y down, z forward): wrist, thumb (cmc, mcp, ip, tip), index, middle, ring, little finger (mcp, pip, dip, tip). */
  joints_m: Vector[];
  /** Translation (3, m), rotation vector (3, rad), joint angles (21, rad). */
  state: (number | null)[];
  /** Coordinates in the pose space. */
  latent: (number | null)[];
  /** Over translation, rotation and latent, square. */
  covariance: ((number | null)[])[];
  /** Of the particles' weights. */
  effective_sample_size: number | null;
  /** The gesture's name, other where it is none that is known; empty while the hand is lost. */
  gesture: string;
  /** How sure the gesture is. */
  gesture_probability: number | null;
  /** How nearly thumb and index finger touch, 0 open to 1 touching. */
  pinch: number | null;
  /** From the beginning to the end of a pinch. */
  pinching: boolean;
  /** Standard deviations of the joints, metres: along the camera's ray, along the finger, across both. */
  joint_sigma_m: Vector[];
  /** Probabilities that the joints are within 40 mm. */
  joint_confidence: (number | null)[];
  /** Which joints may be used. */
  joint_ok: boolean[];
  /** The index finger's base while it points, metres. */
  pointing_origin_m: Vector;
  /** Unit vector from there to the finger's tip. */
  pointing_direction: Vector;
  /** The joints as MediaPipe's landmarks: x, y in parts of the image's width and height (image_size_px), z the depth beyond the wrist's in parts of the width. */
  landmarks: Vector[];
  /** Metres, the joints of XR_EXT_hand_tracking; x right, y up, -z forward. */
  openxr_position_m: Vector[];
  /** Of these joints. */
  openxr_orientation: Quaternion[];
  /** Metres from these joints to the skin. */
  openxr_radius_m: (number | null)[];
}

/** Which of several hands it is. */
export interface Slot {
  /** Stays the same while the hand is followed. */
  slot: 0 | 1 | 2 | 3 | 4 | 5 | 6 | 7;
}

/** A hand, and its slot. */
export type HandInSlot = Slot & Hand;

/** The hands that are there. */
export interface Hands {
  /** None to N. */
  hands: HandInSlot[];
}

/** A line with hands=1. */
export type OneHand = Frame & Hand;

/** A line with hands=N, 2 to 8. */
export type SeveralHands = Frame & Hands;

/** A line of track.jsonl, and of stream=stdout, udp and websocket with all fields. What is no number (NaN) is null. */
export type Line = OneHand | SeveralHands;
