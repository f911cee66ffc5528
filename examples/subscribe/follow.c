/* Follows the face of a session from C. Needs only libzmq 4.3 (Debian: libzmq3-dev).

   cc -std=c11 -Wall -o follow follow.c -lzmq
   ./follow [SESSION [CONTROL-ADDRESS]]
   (default: the newest session, $KOUXING_CONTROL or tcp://127.0.0.1:5550)

   Prints a line per frame, 50 per second: the time of its sound and the opening of the jaw, one of
   ARKit's 52 weights. It waits for a session, follows it to other hosts, and ends with the session.
   proto/PROTOCOL.md describes all messages and lists the names of the weights. */

#define _POSIX_C_SOURCE 200809L
#include <errno.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <zmq.h>

enum { KEY_LENGTH = 40, MAX_NAME = 64, MAX_ID = 128, MAX_ENDPOINT = 256 };
enum { NUM_WEIGHTS = 52, JAW_OPEN = 24 }; /* index in ARKit's names */
enum { LAST_FRAMES_MS = 500 }; /* time for the last frames of a session that control has closed */

static void fail(const char *what) {
  fprintf(stderr, "follow: %s\n", what);
  exit(1);
}

/* --- msgpack: the parts that reading maps requires ---------------------------------------------- */
/* Own code, so that this file can be added to any project. msgpack-c would replace about 80 lines. */

typedef struct {
  const uint8_t *at, *end;
} Bytes;

typedef struct {
  enum { NUMBER, STRING, ARRAY, MAP } kind; /* STRING: text or binary */
  double number;
  uint32_t size;       /* bytes of a string, items of an array, pairs of a map */
  const uint8_t *text; /* of a string */
} Value;

static uint64_t big_endian(Bytes *in, int num_bytes) {
  uint64_t number = 0;
  if (in->end - in->at < num_bytes) fail("a message is truncated");
  while (num_bytes-- > 0) number = number << 8 | *in->at++;
  return number;
}

/* Read a value; for an array or a map, only its size. */
static Value read_value(Bytes *in) {
  Value value = {NUMBER, 0, 0, NULL};
  uint8_t tag = (uint8_t)big_endian(in, 1);
  if (tag <= 0x7f) value.number = tag;
  else if (tag <= 0x8f) value.kind = MAP, value.size = tag & 0x0f;
  else if (tag <= 0x9f) value.kind = ARRAY, value.size = tag & 0x0f;
  else if (tag <= 0xbf) value.kind = STRING, value.size = tag & 0x1f;
  else if (tag >= 0xe0) value.number = (int8_t)tag;
  else switch (tag) {
    case 0xc0: case 0xc2: break;          /* nil, false */
    case 0xc3: value.number = 1; break;   /* true */
    case 0xc4: case 0xd9: value.kind = STRING, value.size = (uint32_t)big_endian(in, 1); break;
    case 0xc5: case 0xda: value.kind = STRING, value.size = (uint32_t)big_endian(in, 2); break;
    case 0xc6: case 0xdb: value.kind = STRING, value.size = (uint32_t)big_endian(in, 4); break;
    case 0xdc: value.kind = ARRAY, value.size = (uint32_t)big_endian(in, 2); break;
    case 0xdd: value.kind = ARRAY, value.size = (uint32_t)big_endian(in, 4); break;
    case 0xde: value.kind = MAP, value.size = (uint32_t)big_endian(in, 2); break;
    case 0xdf: value.kind = MAP, value.size = (uint32_t)big_endian(in, 4); break;
    case 0xcb: { uint64_t bits = big_endian(in, 8); memcpy(&value.number, &bits, 8); break; }
    case 0xcc: case 0xcd: case 0xce: case 0xcf:
      value.number = (double)big_endian(in, 1 << (tag - 0xcc));
      break;
    case 0xd0: value.number = (int8_t)big_endian(in, 1); break;
    case 0xd1: value.number = (int16_t)big_endian(in, 2); break;
    case 0xd2: value.number = (int32_t)big_endian(in, 4); break;
    case 0xd3: value.number = (double)(int64_t)big_endian(in, 8); break;
    default: fail("a message has a type that the protocol does not use");
  }
  if (value.kind == STRING) {
    if (in->end - in->at < (ptrdiff_t)value.size) fail("a message is truncated");
    value.text = in->at;
    in->at += value.size;
  }
  return value;
}

static void skip(Bytes *in) {
  Value value = read_value(in);
  if (value.kind == STRING || value.kind == NUMBER) return;
  for (uint64_t left = value.kind == MAP ? 2 * (uint64_t)value.size : value.size; left > 0; left--)
    skip(in);
}

/* Find the value of a key in a map; return false if the key is missing. */
static bool find(Bytes map, const char *key, Bytes *value) {
  Value pairs = read_value(&map);
  if (pairs.kind != MAP) return false;
  while (pairs.size-- > 0) {
    Value name = read_value(&map);
    *value = map;
    if (name.kind == STRING && name.size == strlen(key) && !memcmp(name.text, key, name.size))
      return true;
    skip(&map);
  }
  return false;
}

/* Copy the text of a key in a map; return false if it is missing or does not fit. */
static bool find_text(Bytes map, const char *key, char *text, size_t capacity) {
  Bytes at;
  if (!find(map, key, &at)) return false;
  Value value = read_value(&at);
  if (value.kind != STRING || value.size >= capacity) return false;
  memcpy(text, value.text, value.size);
  text[value.size] = '\0';
  return true;
}

/* Return whether a message is not about an earlier session with the same name. */
static bool is_about(Bytes message, const char *id) {
  char other[MAX_ID + 1];
  return !*id || !find_text(message, "session_id", other, sizeof other) || !strcmp(other, id);
}

static double find_number(Bytes map, const char *key) {
  Bytes at;
  return find(map, key, &at) ? read_value(&at).number : 0;
}

/* --- sockets ------------------------------------------------------------------------------------ */

typedef struct {
  char public[KEY_LENGTH + 1], secret[KEY_LENGTH + 1], control[KEY_LENGTH + 1];
} Key;

/* Read a key from a JSON object of three strings. */
static void read_key(const char *json, const char *name, char *key) {
  char quoted[16];
  snprintf(quoted, sizeof quoted, "\"%s\"", name);
  const char *at = strstr(json, quoted);
  at = at ? strchr(at + strlen(quoted), '"') : NULL;
  if (!at || strlen(at) <= KEY_LENGTH) fail("client.key is not a key file");
  memcpy(key, at + 1, KEY_LENGTH);
  key[KEY_LENGTH] = '\0';
}

static Key user_key(void) {
  char path[4096], json[1024] = "";
  const char *state = getenv("XDG_STATE_HOME"), *home = getenv("HOME");
  if (state && *state) snprintf(path, sizeof path, "%s/kouxing/client.key", state);
  else snprintf(path, sizeof path, "%s/.local/state/kouxing/client.key", home ? home : "");
  FILE *file = fopen(path, "r");
  if (!file || fread(json, 1, sizeof json - 1, file) == 0)
    fail("no client.key: start kouxing, or copy the file from its machine");
  fclose(file);
  Key key;
  read_key(json, "public", key.public);
  read_key(json, "secret", key.secret);
  read_key(json, "control", key.control);
  return key;
}

/* Connect to an endpoint: an address and the server's public key, "tcp://HOST:PORT KEY". */
static void connect_to(void *socket, const char *endpoint, const Key *key) {
  char address[MAX_ENDPOINT + 1], server[MAX_ENDPOINT + 1];
  if (sscanf(endpoint, "%256s %256s", address, server) != 2) fail("an endpoint has no key");
  if (zmq_setsockopt(socket, ZMQ_CURVE_SERVERKEY, server, KEY_LENGTH + 1) ||
      zmq_setsockopt(socket, ZMQ_CURVE_PUBLICKEY, key->public, KEY_LENGTH + 1) ||
      zmq_setsockopt(socket, ZMQ_CURVE_SECRETKEY, key->secret, KEY_LENGTH + 1) ||
      zmq_connect(socket, address))
    fail(zmq_strerror(zmq_errno()));
}

/* Receive the two parts of a message; `body` is valid until the next call. */
static Bytes receive(void *socket, char *topic, size_t capacity, zmq_msg_t *body) {
  int size = zmq_recv(socket, topic, capacity - 1, 0);
  if (size < 0 && zmq_errno() == EAGAIN) fail("control does not answer; start it with: kouxing run");
  if (size < 0 || zmq_msg_recv(body, socket, 0) < 0) fail(zmq_strerror(zmq_errno()));
  topic[(size_t)size < capacity ? (size_t)size : capacity - 1] = '\0';
  const uint8_t *data = zmq_msg_data(body);
  return (Bytes){data, data + zmq_msg_size(body)};
}

/* --- the program -------------------------------------------------------------------------------- */

/* Send control a request about a session and receive the answer; `rest` is one more field. */
static Bytes ask(void *control, const char *kind, const char *session, const char *rest,
                 zmq_msg_t *answer) {
  static int number = 0;
  char topic[MAX_NAME + 32], request[16], body[192];
  snprintf(topic, sizeof topic, "%s/%s/", kind, session);
  snprintf(request, sizeof request, "%d", ++number);
  /* a map: an integer, two strings preceded by their lengths, and the rest */
  int size = snprintf(body, sizeof body, "%c\xa7version\x03\xa7session\xd9%c%s\xa7request%c%s%s",
                      *rest ? 0x84 : 0x83, (int)strlen(session), session,
                      0xa0 + (int)strlen(request), request, rest);
  zmq_send(control, topic, strlen(topic), ZMQ_SNDMORE);
  zmq_send(control, body, (size_t)size, 0);
  return receive(control, topic, sizeof topic, answer);
}

/* Ask control for the wanted session, or the newest; return false if there is no session yet. */
static bool find_session(void *control, const char *wanted, char *name, char *id, char *faps) {
  zmq_msg_t answer;
  zmq_msg_init(&answer);
  Bytes report = ask(control, "status-request", wanted, "", &answer), sessions, endpoints;
  double min_age_s = 1e300;
  if (find(report, "sessions", &sessions)) { /* an error has no sessions */
    for (uint32_t left = read_value(&sessions).size; left > 0; left--, skip(&sessions)) {
      double age_s = find_number(sessions, "age_s");
      if (age_s < min_age_s && find(sessions, "endpoints", &endpoints) &&
          find_text(endpoints, "faps", faps, MAX_ENDPOINT + 1) &&
          find_text(sessions, "session", name, MAX_NAME + 1)) {
        min_age_s = age_s;
        if (!find_text(sessions, "session_id", id, MAX_ID + 1)) *id = '\0';
      }
    }
  }
  zmq_msg_close(&answer);
  return min_age_s < 1e300;
}

/* Ask control where it publishes that sessions move. */
static void find_events(void *control, char *events) {
  zmq_msg_t answer;
  zmq_msg_init(&answer);
  Bytes services, endpoints;
  bool is_found = false;
  if (find(ask(control, "status-request", "", "", &answer), "services", &services))
    for (uint32_t left = read_value(&services).size; left > 0 && !is_found; left--, skip(&services))
      is_found = find(services, "endpoints", &endpoints) &&
              find_text(endpoints, "events", events, MAX_ENDPOINT + 1); /* only control has them */
  zmq_msg_close(&answer);
  if (!is_found) fail("control does not publish events");
}

/* Subscribe to a kind of message of a session, or unsubscribe. */
static void set_subscription(void *socket, int option, const char *kind, const char *session) {
  char topic[MAX_NAME + 32];
  int size = snprintf(topic, sizeof topic, "%s/%s/", kind, session);
  zmq_setsockopt(socket, option, topic, (size_t)size);
}

int main(int num_arguments, char **arguments) {
  const char *wanted = num_arguments > 1 ? arguments[1] : "";
  const char *address = num_arguments > 2 ? arguments[2] : getenv("KOUXING_CONTROL");
  if (!address || !*address) address = "tcp://127.0.0.1:5550";
  if (strlen(wanted) > MAX_NAME) fail("a session's name has at most 64 characters");
  Key key = user_key();
  void *context = zmq_ctx_new();

  char endpoint[MAX_ENDPOINT + 1], name[MAX_NAME + 1], id[MAX_ID + 1], events[MAX_ENDPOINT + 1];
  snprintf(endpoint, sizeof endpoint, "%s %s", address, key.control);
  void *control = zmq_socket(context, ZMQ_DEALER);
  int max_wait_ms = 15000, linger_ms = 0;
  zmq_setsockopt(control, ZMQ_RCVTIMEO, &max_wait_ms, sizeof max_wait_ms);
  zmq_setsockopt(control, ZMQ_LINGER, &linger_ms, sizeof linger_ms);
  connect_to(control, endpoint, &key);
  while (!find_session(control, wanted, name, id, endpoint))
    nanosleep(&(struct timespec){.tv_nsec = 500000000}, NULL);
  find_events(control, events);

  void *face = zmq_socket(context, ZMQ_SUB);
  connect_to(face, endpoint, &key);
  set_subscription(face, ZMQ_SUBSCRIBE, "session-moved", name);
  set_subscription(face, ZMQ_SUBSCRIBE, "event", name);
  set_subscription(face, ZMQ_SUBSCRIBE, "fap-frame", name);
  set_subscription(face, ZMQ_SUBSCRIBE, "end-of-faps", name);
  set_subscription(face, ZMQ_SUBSCRIBE, "joined", name); /* last, so no frame is missed */

  double epoch = 0, newest = -1, newest_number = 0; /* of the frames shown */
  bool following = false, is_closed = false;
  zmq_msg_t body;
  zmq_msg_init(&body);
  for (;;) {
    char topic[MAX_NAME + 32], event[MAX_ID + 1];
    zmq_pollitem_t arrival = {.socket = face, .events = ZMQ_POLLIN};
    if (is_closed && zmq_poll(&arrival, 1, LAST_FRAMES_MS) == 0) fail("control has closed the session");
    Bytes message = receive(face, topic, sizeof topic, &body), shapes, at;
    double time = find_number(message, "media_time"), number = find_number(message, "sequence");
    if (!strncmp(topic, "end-of-faps/", 12) && find_number(message, "epoch") >= epoch) break;
    if (!strncmp(topic, "joined/", 7) && !following) { /* arrives for every new subscriber */
      following = true;
      zmq_msg_t answer;
      zmq_msg_init(&answer);
      /* face: a map of one, shapes: a list of one */
      ask(control, "set-face", name, "\xa4" "face\x81\xa6shapes\x91\xa5" "arkit", &answer);
      zmq_msg_close(&answer);
      connect_to(face, events, &key); /* control publishes there when the session moves */
      printf("following %s\n", name);
    } else if (!strncmp(topic, "session-moved/", 14) && is_about(message, id) &&
               find_text(message, "faps", endpoint, sizeof endpoint)) {
      epoch = find_number(message, "epoch");
      connect_to(face, endpoint, &key);
      set_subscription(face, ZMQ_UNSUBSCRIBE, "joined", name);
      set_subscription(face, ZMQ_SUBSCRIBE, "joined", name); /* after joining, the newest frames arrive again */
    } else if (!strncmp(topic, "event/", 6)) {
      is_closed |= find_text(message, "name", event, sizeof event) && !strcmp(event, "session-closed") && is_about(message, id);
    } else if (find(message, "shapes", &shapes) && find(shapes, "arkit", &at) &&
               (time > newest || (time == newest && number > newest_number))) {
      newest = time, newest_number = number;
      Value values = read_value(&at);
      float weights[NUM_WEIGHTS]; /* little-endian, as on common machines */
      if (values.kind != STRING || values.size != sizeof weights) fail("a frame has an unknown number of weights");
      memcpy(weights, values.text, sizeof weights);
      printf("%.3f %.2f\n", time / 16000, weights[JAW_OPEN]);
    }
    fflush(stdout);
  }
  zmq_msg_close(&body);
  zmq_close(face);
  zmq_close(control);
  zmq_ctx_destroy(context);
  return 0;
}
