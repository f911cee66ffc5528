#include "face.h"

#include <math.h>
#include <string.h>

static const Mouth AT_REST = {{0}, {0}};

static double clamp(double x, double lowest, double highest) { return fmin(fmax(x, lowest), highest); }

static double smooth_step(double x) {
  x = clamp(x, 0.0, 1.0);
  return x * x * (3.0 - 2.0 * x);
}

/* Return what remains of a difference on its way to zero, a cubic; u goes from 0 to 1. */
static double remaining(double value, double velocity, double u, double duration_s) {
  return (1.0 - u) * (1.0 - u) * ((1.0 + 2.0 * u) * value + u * duration_s * velocity);
}

static double remaining_velocity(double value, double velocity, double u, double duration_s) {
  return (1.0 - u) * (-6.0 * u * value / duration_s + (1.0 - 3.0 * u) * velocity);
}

/* ---- track ---- */

static double track_end_s(const Track *track) {
  return track->num_knots ? track->knots[track->num_knots - 1].time_s : -INFINITY;
}

static void drop_knots(Track *track, int number) {
  track->num_knots -= number;
  memmove(track->knots, track->knots + number, track->num_knots * sizeof(Knot));
}

static void add_knot(Track *track, double time_s, const Mouth *mouth) {
  if (track->num_knots == MAX_KNOTS) drop_knots(track, 1);
  track->knots[track->num_knots].time_s = time_s;
  track->knots[track->num_knots++].mouth = *mouth;
}

static void track_append(Track *track, double time_s, const double *faps) {
  Mouth mouth = AT_REST;
  const double elapsed_s = time_s - track_end_s(track);
  memcpy(mouth.value, faps, sizeof mouth.value);
  if (elapsed_s <= TRACK_MAX_GAP_S) {
    const double *last = track->knots[track->num_knots - 1].mouth.value;
    for (int i = 0; i < NUM_MOUTH_FAPS; i++) mouth.velocity[i] = (faps[i] - last[i]) / elapsed_s;
  } else {
    if (track->num_knots) add_knot(track, track_end_s(track) + TRACK_CLOSE_S, &AT_REST);
    add_knot(track, time_s - TRACK_OPEN_S, &AT_REST);
  }
  add_knot(track, time_s, &mouth);
}

/* Return the number of knots up to a time. */
static int num_knots_until(const Track *track, double time_s) {
  int number = 0;
  while (number < track->num_knots && track->knots[number].time_s <= time_s) number++;
  return number;
}

static void track_forget_before(Track *track, double time_s) {
  const int number = num_knots_until(track, time_s) - 1;
  if (number > 0) drop_knots(track, number);
}

/* Return the cubic Hermite spline between two knots. */
static Mouth interpolate(const Knot *before, const Knot *after, double time_s) {
  const double duration_s = after->time_s - before->time_s;
  const double u = (time_s - before->time_s) / duration_s;
  Mouth mouth;
  for (int i = 0; i < NUM_MOUTH_FAPS; i++) {
    const double x = before->mouth.value[i], step = after->mouth.value[i] - x;
    const double v = before->mouth.velocity[i], end = after->mouth.velocity[i];
    mouth.value[i] = x + u * u * (3 - 2 * u) * step + u * (1 - u) * duration_s * ((1 - u) * v - u * end);
    mouth.velocity[i] = 6 * u * (1 - u) * step / duration_s + (1 - u) * (1 - 3 * u) * v + u * (3 * u - 2) * end;
  }
  return mouth;
}

static Mouth track_at(const Track *track, double time_s) {
  if (!track->num_knots || time_s < track->knots[0].time_s) return AT_REST;
  const Knot *last = &track->knots[track->num_knots - 1];
  if (time_s < last->time_s) {
    const int after = num_knots_until(track, time_s);
    return interpolate(&track->knots[after - 1], &track->knots[after], time_s);
  }
  const Knot rest = {last->time_s + track->hold_s + TRACK_CLOSE_S, AT_REST};
  if (time_s >= rest.time_s) return AT_REST;
  if (track->hold_s == 0.0) return interpolate(last, &rest, time_s);
  Knot held = {last->time_s + track->hold_s, AT_REST};
  memcpy(held.mouth.value, last->mouth.value, sizeof held.mouth.value);
  return time_s < held.time_s ? interpolate(last, &held, time_s) : interpolate(&held, &rest, time_s);
}

/* ---- lips in pauses ---- */

static bool is_sound(const Rest *rest, double level_db) {
  return rest->is_voice && level_db >= rest->loudest_db - REST_RANGE_DB;
}

static double next_sound_s(const Rest *rest) {
  for (int i = 0; i < rest->num_levels; i++) {
    if (is_sound(rest, rest->levels[i].level_db)) return rest->levels[i].time_s;
  }
  return INFINITY;
}

static void update_background(Rest *rest, double level) {
  const double level_db = fmax(level, REST_MIN_BACKGROUND_DB);
  rest->num_processed_levels++;
  if (rest->num_processed_levels <= REST_NUM_FIRST_LEVELS) {
    rest->background_db += (level_db - rest->background_db) / rest->num_processed_levels;
    return;
  }
  const double difference = level_db - rest->background_db;
  rest->background_db += difference > REST_ONSET_DB ? REST_BACKGROUND_RISE_DB : REST_BACKGROUND_RATE * difference;
}

/* Return whether an onset before the first voice activity closes the lips. */
static bool closes_for_onset(Rest *rest, double time_s) {
  if (rest->has_spoken || rest->num_processed_levels < REST_NUM_FIRST_LEVELS) return false;
  if (time_s > rest->onset_until_s) {
    const double onset_db = rest->background_db + REST_ONSET_DB, end_s = time_s + REST_ONSET_LEAD_S;
    for (int i = 0; i < rest->num_levels; i++) {
      const Level *level = &rest->levels[i];
      if (level->time_s <= end_s && level->level_db > onset_db) rest->onset_until_s = time_s + REST_ONSET_S;
    }
  }
  return time_s <= rest->onset_until_s;
}

static double ajar_amount(const Rest *rest) {
  const double u = fmin(rest->elapsed_s / rest->duration_s, 1.0);
  return rest->goal + remaining(rest->start, rest->velocity, u, rest->duration_s);
}

static void set_goal(Rest *rest, double goal, double duration_s) {
  if (goal == rest->goal) return;
  const double u = fmin(rest->elapsed_s / rest->duration_s, 1.0);
  const double amount = ajar_amount(rest);
  rest->velocity = remaining_velocity(rest->start, rest->velocity, u, rest->duration_s);
  rest->start = amount - goal;
  rest->goal = goal;
  rest->duration_s = duration_s;
  rest->elapsed_s = 0.0;
}

/* Process the events up to the time of a frame. */
static void follow_voice(Rest *rest, double time_s) {
  int number = 0;
  for (; number < rest->num_changes && rest->changes[number].time_s <= time_s; number++) {
    const SpeechChange change = rest->changes[number];
    if (change.is_active && !rest->is_voice) {
      rest->sound_s = change.time_s;
      rest->stays_closed = false;
    }
    rest->is_voice = change.is_active;
    rest->has_spoken |= change.is_active;
  }
  rest->num_changes -= number;
  memmove(rest->changes, rest->changes + number, rest->num_changes * sizeof(SpeechChange));
  for (number = 0; number < rest->num_levels && rest->levels[number].time_s <= time_s; number++) {
    update_background(rest, rest->levels[number].level_db);
    if (is_sound(rest, rest->levels[number].level_db)) {
      rest->sound_s = rest->levels[number].time_s;
      rest->stays_closed = false;
    }
  }
  rest->num_levels -= number;
  memmove(rest->levels, rest->levels + number, rest->num_levels * sizeof(Level));
}

/* Return the log odds that silence subtracts from a closure. */
static double doubt_at(Rest *rest, double time_s, double closure) {
  const double next_s = next_sound_s(rest);
  const bool is_silent = rest->is_voice && rest->known_s > time_s + REST_LAST_SOUND_S && next_s > rest->known_s;
  const bool is_onset = REST_YIELD_S < next_s - time_s && next_s - time_s <= REST_LIKELY_BEFORE_S;
  if (closure >= (is_onset ? REST_LIKELY : REST_CERTAIN)) {
    if (is_silent || is_onset) rest->stays_closed = true;
    return 0.0;
  }
  if (rest->goal > 0.0) return INFINITY;
  return is_silent ? REST_DOUBT : 0.0;
}

static double ajar_amount_at(Rest *rest, double time_s) {
  const double next_s = next_sound_s(rest);
  bool starts_soon = false;
  for (int i = 0; i < rest->num_changes; i++) {
    starts_soon |= rest->changes[i].is_active && rest->changes[i].time_s <= time_s + REST_LEAD_S;
  }
  if (starts_soon) set_goal(rest, 1.0, REST_PART_S);
  else if (rest->stays_closed || next_s <= time_s + REST_YIELD_S) set_goal(rest, 0.0, REST_YIELD_S);
  else if (closes_for_onset(rest, time_s)) set_goal(rest, 0.0, REST_ONSET_CLOSE_S);
  else if (time_s > rest->sound_s + REST_HOLD_S) set_goal(rest, 0.0, REST_CLOSE_S);
  else if (!rest->is_voice || fmin(next_s, rest->known_s) >= rest->sound_s + REST_MIN_PAUSE_S) set_goal(rest, 1.0, REST_PART_S);
  rest->elapsed_s += fmax(time_s - rest->time_s, 0.0);
  rest->time_s = time_s;
  return ajar_amount(rest);
}

/* ---- learned lips ---- */

/* Move inner lips towards rest, and the outer lips by the same distance. */
static void move_to_rest(double *faps, double amount) {
  for (int i = 0; i < CLOSURES_INNER_LENGTH; i++) {
    const double shift = amount * faps[CLOSURES_INNER[i]];
    faps[CLOSURES_INNER[i]] -= shift;
    faps[CLOSURES_OUTER[i]] -= shift;
  }
}

/* Separate lips that pass through each other. */
static void separate_lips(double *faps) {
  for (int i = 0; i < CLOSURES_UPPER_LENGTH; i++) {
    const double crossed = fmax(0.0, faps[CLOSURES_UPPER[i]] + faps[CLOSURES_LOWER[i]]);
    for (int row = 0; row < CLOSURES_BOTH_LENGTH; row++) faps[CLOSURES_BOTH[row * CLOSURES_UPPER_LENGTH + i]] -= 0.5 * crossed;
  }
}

/* Compute the FAPs of the next lip positions, stabilized and with closures. */
static void stabilize(Face *face, const LipPositions *frame, double *faps) {
  if (frame->time_s - track_end_s(&face->track) <= LEARNED_MAX_GAP_S) {
    for (int i = 0; i < NUM_MOUTH_FAPS; i++) {
      const double change = frame->faps[i] - face->stable[i];
      if (change != 0.0) face->stable[i] += change * change * change / (change * change + LEARNED_JITTER_SQUARED[i]);
    }
  } else {
    face->closing[0] = face->closing[1] = 0.0;
    memcpy(face->stable, frame->faps, sizeof face->stable);
  }
  memcpy(faps, face->stable, sizeof face->stable);
  separate_lips(faps);
  const double probability = clamp(frame->closure, CLOSURES_MIN_PROBABILITY, CLOSURES_MAX_PROBABILITY);
  const double opening = -(faps[CLOSURES_INNER_UPPER] + faps[CLOSURES_INNER_LOWER]);
  const double width = faps[CLOSURES_LEFT_CORNER] + faps[CLOSURES_RIGHT_CORNER];
  double closure = RULE_SOUND + log(probability / (1.0 - probability));
  closure -= RULE_PARTED * (clamp(opening, CLOSURES_PARTED, CLOSURES_WIDE_APART) - CLOSURES_PARTED);
  closure -= RULE_ROUNDED * fmax(0.0, CLOSURES_ROUNDED - width);
  closure -= doubt_at(&face->rest, frame->time_s, frame->closure);
  double amount = smooth_step(0.5 + 0.5 * closure / RULE_DOUBT);
  const double before = face->closing[0], newest = face->closing[1];
  if (before < LEARNED_CLOSED_FRACTION && LEARNED_CLOSED_FRACTION <= newest) amount = fmax(amount, newest);
  face->closing[0] = newest;
  face->closing[1] = amount;
  move_to_rest(faps, amount);
}

static void extend_track(Face *face, double time_s) {
  int number = 0;
  track_forget_before(&face->track, face->time_s);
  for (; number < face->num_queued && track_end_s(&face->track) < time_s; number++) {
    double faps[NUM_MOUTH_FAPS];
    const LipPositions *frame = &face->queue[number];
    stabilize(face, frame, faps);
    track_append(&face->track, frame->time_s, faps);
    face->late_s = fmax(0.0, frame->delay_s - DELAY_S);
  }
  face->num_queued -= number;
  memmove(face->queue, face->queue + number, face->num_queued * sizeof(LipPositions));
  face->track.hold_s = face->is_speaking ? TRACK_HOLD_S + face->late_s : 0.0;
}

static void follow_track(Face *face, double time_s) {
  const bool continues = track_end_s(&face->track) >= face->time_s;
  extend_track(face, time_s);
  if (!continues) {
    const Mouth now = track_at(&face->track, face->time_s);
    bool is_different = false;
    for (int i = 0; i < NUM_MOUTH_FAPS; i++) {
      is_different |= fabs(face->on_track.value[i] - now.value[i]) > LEARNED_EPSILON;
      is_different |= fabs(face->on_track.velocity[i] - now.velocity[i]) > LEARNED_EPSILON;
    }
    if (is_different) {
      for (int i = 0; i < NUM_MOUTH_FAPS; i++) {
        face->difference.value[i] = face->mouth.value[i] - now.value[i];
        face->difference.velocity[i] = face->mouth.velocity[i] - now.velocity[i];
      }
      face->transition_s = face->time_s;
    }
  }
  face->on_track = track_at(&face->track, time_s);
  const double u = fmin((time_s - face->transition_s) / LEARNED_TRANSITION_S, 1.0);
  for (int i = 0; i < NUM_MOUTH_FAPS; i++) {
    const double value = face->difference.value[i], velocity = face->difference.velocity[i];
    face->mouth.value[i] = face->on_track.value[i] + remaining(value, velocity, u, LEARNED_TRANSITION_S);
    face->mouth.velocity[i] = face->on_track.velocity[i] + remaining_velocity(value, velocity, u, LEARNED_TRANSITION_S);
  }
}

/* ---- size of the movements; modifiers/expressiveness.py has the formulas ---- */

static double growth(double opening) {
  const double within = fmin(opening, EXPRESSIVENESS_WIDEST / 2.0);
  return (EXPRESSIVENESS - 1.0) * within * (1.0 - within / EXPRESSIVENESS_WIDEST);
}

static void apply_expressiveness(double *faps) {
  const double span = EXPRESSIVENESS_OPEN - EXPRESSIVENESS_CLOSED, more = EXPRESSIVENESS_SIDEWAYS * (EXPRESSIVENESS - 1.0);
  const double gap = -faps[EXPRESSIVENESS_UPPER[0]] - faps[EXPRESSIVENESS_LOWER[0]];
  double is_open = 0.0;
  for (int i = 0; i < EXPRESSIVENESS_UPPER_LENGTH; i++) {
    double *upper = &faps[EXPRESSIVENESS_UPPER[i]], *lower = &faps[EXPRESSIVENESS_LOWER[i]];
    const double beyond = fmax(-*upper - *lower - EXPRESSIVENESS_CLOSED, 0.0);
    const double free_upper = fmax(-*upper - EXPRESSIVENESS_CLOSED, 0.0);
    const double free_lower = fmax(-*lower - EXPRESSIVENESS_CLOSED, 0.0);
    const double both = free_upper + free_lower, apart = fmin(free_lower / span, 1.0);
    if (i == 0) is_open = apart * clamp((gap - EXPRESSIVENESS_CLOSED) / span, 0.0, 1.0);
    const double grown = apart * growth(fmin(both, beyond)) / fmax(both, 1.0);
    *upper -= grown * free_upper;
    *lower -= grown * free_lower;
  }
  faps[EXPRESSIVENESS_JAW] += is_open * growth(fmax(faps[EXPRESSIVENESS_JAW], 0.0));
  for (int i = 0; i < EXPRESSIVENESS_WIDTH_LENGTH; i++) {
    double *fap = &faps[EXPRESSIVENESS_WIDTH[i]];
    const double width = *fap - EXPRESSIVENESS_USUAL_WIDTH;
    *fap = fmax(*fap + more * (width > 0.0 ? is_open * width : width), fmin(*fap, EXPRESSIVENESS_MIN_WIDTH));
  }
  for (int i = 0; i < EXPRESSIVENESS_PUSH_LENGTH; i++) {
    double *fap = &faps[EXPRESSIVENESS_PUSH[i]];
    *fap = fmin(*fap + more * fmax(*fap - EXPRESSIVENESS_USUAL_PUSH, 0.0), fmax(*fap, EXPRESSIVENESS_MAX_PUSH));
  }
}

/* ---- visemes; shared/face/shapes.py has equation (2) and the algorithm ---- */

/* Solve equations with a symmetric positive definite matrix (Cholesky); the right side becomes the solution. */
static void solve(double matrix[][NUM_SHAPES], double *right, int size) {
  for (int i = 0; i < size; i++) {
    for (int j = 0; j <= i; j++) {
      double sum = matrix[i][j];
      for (int k = 0; k < j; k++) sum -= matrix[i][k] * matrix[j][k];
      matrix[i][j] = i == j ? sqrt(sum) : sum / matrix[j][j];
    }
  }
  for (int i = 0; i < size; i++) {
    for (int k = 0; k < i; k++) right[i] -= matrix[i][k] * right[k];
    right[i] /= matrix[i][i];
  }
  for (int i = size - 1; i >= 0; i--) {
    for (int k = i + 1; k < size; k++) right[i] -= matrix[k][i] * right[k];
    right[i] /= matrix[i][i];
  }
}

static double negative_gradient(const double *right, const double *weights, int shape) {
  double sum = right[shape];
  for (int i = 0; i < NUM_SHAPES; i++) sum -= SHAPES_OCULUS_GRAM[shape * NUM_SHAPES + i] * weights[i];
  return sum;
}

static void solve_weights(Face *face, const double *right, double *weights) {
  int fewest = NUM_SHAPES + 1, patience = SHAPES_PATIENCE;
  for (;;) {
    double matrix[NUM_SHAPES][NUM_SHAPES], solution[NUM_SHAPES];
    int inner[NUM_SHAPES], wrong[NUM_SHAPES], num_inner = 0, num_wrong = 0;
    for (int i = 0; i < NUM_SHAPES; i++) {
      weights[i] = face->at_one[i];
      if (face->free[i]) inner[num_inner++] = i;
    }
    for (int i = 0; i < num_inner; i++) {
      solution[i] = negative_gradient(right, weights, inner[i]);
      for (int j = 0; j < num_inner; j++) matrix[i][j] = SHAPES_OCULUS_GRAM[inner[i] * NUM_SHAPES + inner[j]];
    }
    solve(matrix, solution, num_inner);
    for (int i = 0; i < num_inner; i++) weights[inner[i]] = solution[i];
    for (int i = 0; i < NUM_SHAPES; i++) {
      const double x = face->free[i] ? 0.0 : negative_gradient(right, weights, i);
      const bool is_outside = weights[i] < -SHAPES_ROUNDING || weights[i] > 1.0 + SHAPES_ROUNDING;
      if (face->free[i] ? is_outside : (face->at_one[i] ? -x : x) > SHAPES_ROUNDING) wrong[num_wrong++] = i;
    }
    if (num_wrong == 0) break;
    int first = 0;
    if (num_wrong < fewest) {
      fewest = num_wrong;
      patience = SHAPES_PATIENCE;
    } else if (patience) patience--;
    else first = num_wrong - 1; /* exchanging only the last one guarantees termination */
    for (int k = first; k < num_wrong; k++) {
      const int i = wrong[k];
      face->at_one[i] = face->free[i] && weights[i] > 1.0 + SHAPES_ROUNDING;
      face->free[i] = !face->free[i];
    }
  }
}

void face_visemes(Face *face, double time_s, float *weights) {
  double mouth[NUM_MOUTH_FAPS], faps[SHAPES_NUM_FAPS] = {0}, right[NUM_SHAPES], solution[NUM_SHAPES], sum = 0.0;
  follow_voice(&face->rest, time_s);
  if (face->has_lip_positions) follow_track(face, time_s);
  const double ajar = ajar_amount_at(&face->rest, time_s);
  face->time_s = time_s;
  memcpy(mouth, face->mouth.value, sizeof mouth);
  separate_lips(mouth); /* an interrupted closing movement overshoots */
  for (int i = 0; i < NUM_MOUTH_FAPS; i++) faps[MOUTH_FAPS[i] - 1] = (float)(mouth[i] + ajar * (REST_AJAR[i] - mouth[i]));
  for (int i = 0; i < LEARNED_UNTRACKED_LENGTH; i++) faps[MOUTH_FAPS[LEARNED_UNTRACKED[i]] - 1] = 0.0;
  apply_expressiveness(faps);
  for (int shape = 0; shape < NUM_SHAPES; shape++) {
    right[shape] = 0.0;
    for (int i = 0; i < SHAPES_NUM_FAPS; i++) right[shape] += SHAPES_OCULUS_RIGHT[shape * SHAPES_NUM_FAPS + i] * faps[i];
  }
  solve_weights(face, right, solution);
  for (int shape = 0; shape < NUM_SHAPES; shape++) {
    weights[shape] = (float)clamp(solution[shape], 0.0, 1.0);
    sum += weights[shape];
  }
  weights[0] = (float)fmax(0.0, 1.0 - sum); /* "sil" is 1 minus the sum of the others */
}

/* ---- events ---- */

void face_init(Face *face) {
  memset(face, 0, sizeof *face);
  face->rest.loudest_db = face->rest.known_s = face->rest.sound_s = face->rest.onset_until_s = -INFINITY;
  face->rest.time_s = INFINITY;
  face->rest.duration_s = 1.0;
}

void face_add_lips(Face *face, const LipPositions *frame) {
  face->has_lip_positions = true;
  if (face->num_queued < MAX_QUEUE) face->queue[face->num_queued++] = *frame;
}

void face_change_speech(Face *face, double time_s, bool is_active) {
  face->is_speaking = is_active;
  if (face->rest.num_changes < MAX_CHANGES) face->rest.changes[face->rest.num_changes++] = (SpeechChange){time_s, is_active};
}

void face_add_level(Face *face, double time_s, double level_db) {
  Rest *rest = &face->rest;
  if (isinf(rest->known_s)) rest->sound_s = time_s;
  if (rest->num_levels < MAX_LEVELS) rest->levels[rest->num_levels++] = (Level){time_s, level_db};
  rest->loudest_db = fmax(level_db, rest->loudest_db - REST_FADE_DB);
  rest->known_s = time_s;
}
