// The numbers in brackets are the sections of protocol/README.md.
#define _POSIX_C_SOURCE 200809L
#include "tube_physics.h"

#include <inttypes.h>
#include <math.h>
#include <sched.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "tube_checks.h"
#include "tube_segments.h"

#define ATTACH_S 30.0 // how long a session is waited for
#define LOOK_AGAIN_S 0.005 // between two looks for one
#define UNFINISHED_S 0.5 // how long a header without its magic is taken for one that is being written
#define POLLS 50 // of the doorbell before the first yield
#define YIELDING_S 0.05 // a wait without progress yields so long before it sleeps
#define LOOK_S 0.03 // between two looks at the agent
#define NAP_MIN_S 0.001
#define NAP_MAX_S 0.015

typedef struct session {
    const tube_plant *plant;
    const volatile sig_atomic_t *stop;
    tube_segments segments;
    const tube_command_segment *command; // the agent's: never written
    tube_pose_segment *pose; // ours; NULL until it is claimed
    tube_settings settings;
    int64_t number; // of the last request that was answered
    int64_t steps; // control steps integrated in this session
    // Private copies of what is on the wire: a plant never sees words that may change under it.
    tube_command_segment request;
    tube_command_row *commands;
    tube_reset_row *resets;
    tube_pose_row *poses;
    bool *was_reset; // each lane
    int64_t *lane_tube; // index of the tube that each lane flies in
    tube_register tubes;
    tube_refusal refusal;
    tube_ending ending;
    char message[1016]; // becomes the text of our farewell
} session;

static_assert(sizeof(tube_refusal) == 1024,
              "a refusal is what stands in the pose segment");

static int64_t acquire(const int64_t *word)
{
    return __atomic_load_n(word, __ATOMIC_ACQUIRE);
}

static void release(int64_t *word, int64_t value)
{
    __atomic_store_n(word, value, __ATOMIC_RELEASE);
}

static int64_t now_ns(void)
{
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

static double seconds_since(int64_t began_ns)
{
    return 1e-9 * (double)(now_ns() - began_ns);
}

static void sleep_s(double seconds)
{
    const struct timespec time = {0, (long)(1e9 * seconds)}; // always less than a second
    nanosleep(&time, NULL);
}

// Notes how the session ends; returns false, which a caller passes on.
static bool end_session(session *s, tube_ending ending, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    tube_write_text(s->message, sizeof s->message, format, arguments);
    va_end(arguments);
    s->ending = ending;
    return false;
}

// ---- handshake [4]

static bool attach(session *s)
{
    const int64_t began = now_ns();
    int64_t whole = began; // the last moment without a half-written header
    while (!*s->stop) {
        const tube_look look = tube_look_for_session(&s->segments, seconds_since(whole) < UNFINISHED_S);
        if (look == TUBE_LOOK_CLAIMED) {
            s->command = s->segments.command.memory;
            s->pose = s->segments.pose.memory;
            return true;
        }
        if (look == TUBE_LOOK_TAKEN)
            return end_session(s, TUBE_END_UNUSABLE, "another physics process serves this session, or has served it");
        if (look == TUBE_LOOK_TOO_SHORT)
            return end_session(s, TUBE_END_HANDSHAKE, "the pose segment is too short for a header");
        if (look != TUBE_LOOK_UNFINISHED)
            whole = now_ns();
        if (seconds_since(began) > ATTACH_S)
            return end_session(s, TUBE_END_LOST, "no session within %g s: is the agent running?", ATTACH_S);
        sleep_s(LOOK_AGAIN_S);
    }
    return end_session(s, TUBE_END_STOPPED, "it was told to stop");
}

static bool demand(session *s, bool holds, const char *field, const char *expected, int64_t found)
{
    return holds || end_session(s, TUBE_END_HANDSHAKE, "%s: expected %s, found %" PRId64, field, expected, found);
}

static bool demand_time(session *s, const char *field, double found)
{
    return (isfinite(found) && found > 0.0) ||
           end_session(s, TUBE_END_HANDSHAKE, "%s: expected a time > 0 s, found %.17g", field, found);
}

static bool check_offer(session *s, const tube_command_segment *offer)
{
    const int64_t lanes = offer->lanes, n = offer->inner_steps, slots = offer->tube_slots;
    const int64_t command_bytes = s->segments.command.bytes, pose_bytes = s->segments.pose.bytes;
    const bool multiple = fabs((double)n * offer->physics_dt - offer->dt) <= 1e-9 * offer->dt;
    return demand(s, offer->magic == TUBE_COMMAND_MAGIC, "magic", "TUBE.CMD", offer->magic) &&
           demand(s, offer->version_major == TUBE_VERSION_MAJOR, "version_major", "1", offer->version_major) &&
           demand(s, lanes >= 1 && lanes <= TUBE_LANES_MAX, "lanes", "1 to 65536", lanes) &&
           demand_time(s, "dt", offer->dt) && demand_time(s, "physics_dt", offer->physics_dt) &&
           demand(s, n >= 1 && n <= TUBE_INNER_STEPS_MAX && multiple, "inner_steps", "dt / physics_dt", n) &&
           demand(s, slots >= 1 && slots <= TUBE_SLOTS_MAX, "tube_slots", "1 to 65536", slots) &&
           demand(s, offer->command_stride == TUBE_COMMAND_STRIDE, "command_stride", "64", offer->command_stride) &&
           demand(s, offer->pose_stride == TUBE_POSE_STRIDE, "pose_stride", "128", offer->pose_stride) &&
           demand(s, offer->reset_stride == TUBE_RESET_STRIDE, "reset_stride", "384", offer->reset_stride) &&
           demand(s, offer->segment_bytes == tube_command_bytes(lanes), "segment_bytes", "6464 + 448 lanes",
                  offer->segment_bytes) &&
           demand(s, command_bytes >= tube_command_bytes(lanes), "bytes of .cmd", "segment_bytes", command_bytes) &&
           demand(s, pose_bytes >= tube_pose_bytes(lanes), "bytes of .pose", "3264 + 128 lanes", pose_bytes);
}

static bool open_worlds(session *s)
{
    const size_t lanes = (size_t)s->settings.lanes;
    s->commands = calloc(lanes, sizeof *s->commands);
    s->resets = calloc(lanes, sizeof *s->resets);
    s->poses = calloc(lanes, sizeof *s->poses);
    s->was_reset = calloc(lanes, sizeof *s->was_reset);
    s->lane_tube = malloc(lanes * sizeof *s->lane_tube);
    s->tubes = (tube_register){calloc((size_t)s->settings.tube_slots, sizeof(bool)), s->settings.tube_slots};
    if (!s->commands || !s->resets || !s->poses || !s->was_reset || !s->lane_tube || !s->tubes.taken)
        return end_session(s, TUBE_END_FAILED, "no memory for %zu lanes", lanes);
    for (size_t lane = 0; lane < lanes; lane++)
        s->lane_tube[lane] = TUBE_NO_TUBE;
    if (s->plant->open(s->plant->self, &s->settings, &s->refusal) != TUBE_STATUS_DONE)
        return end_session(s, TUBE_END_FAILED, "the worlds could not be opened: %s", s->refusal.found);
    return true;
}

static bool shake_hands(session *s)
{
    tube_command_segment *const offer = &s->request; // a copy: what was checked is what is used
    tube_pose_segment *const pose = s->pose;
    memcpy(offer, s->command, offsetof(tube_command_segment, gap_128));
    pose->pid = getpid(); // first, so that a header that is cut short says whose it was
    pose->start_time = tube_start_time();
    if (!check_offer(s, offer))
        return false;
    s->settings = (tube_settings){offer->lanes, offer->dt, offer->physics_dt, offer->inner_steps, offer->tube_slots};
    if (!open_worlds(s))
        return false;
    pose->version_major = TUBE_VERSION_MAJOR;
    pose->version_minor = TUBE_VERSION_MINOR;
    pose->segment_bytes = tube_pose_bytes(offer->lanes);
    memcpy(pose->session, offer->session, sizeof pose->session);
    pose->lanes = offer->lanes;
    pose->dt = offer->dt;
    pose->physics_dt = offer->physics_dt;
    pose->inner_steps = offer->inner_steps;
    pose->tube_slots = offer->tube_slots;
    pose->command_stride = TUBE_COMMAND_STRIDE;
    pose->pose_stride = TUBE_POSE_STRIDE;
    pose->reset_stride = TUBE_RESET_STRIDE;
    pose->speed_max = s->plant->speed_max;
    pose->walls = s->plant->walls;
    pose->defaults = s->plant->defaults;
    tube_put_text(pose->plant_name, sizeof pose->plant_name, "%s", s->plant->name);
    tube_put_text(pose->plant_version, sizeof pose->plant_version, "%s", s->plant->version);
    tube_put_text(pose->plant_engine, sizeof pose->plant_engine, "%s", s->plant->engine);
    release(&pose->magic, TUBE_POSE_MAGIC);
    return true;
}

// ---- one exchange [5, 6, 8, 10]

static bool wait_for_request(session *s)
{
    const int64_t *const doorbell = &s->command->doorbell;
    for (int i = 0; i < POLLS; i++)
        if (acquire(doorbell) != s->number)
            return true;
    const int64_t began = now_ns();
    double look_at = LOOK_S, nap = NAP_MIN_S;
    while (acquire(doorbell) == s->number) {
        const double waited = seconds_since(began);
        if (*s->stop)
            return end_session(s, TUBE_END_STOPPED, "it was told to stop (signal %d)", (int)*s->stop);
        if (waited >= look_at) {
            const int64_t farewell = acquire(&s->command->farewell);
            const bool dead = tube_agent_is_dead(&s->segments);
            if ((farewell || dead) && acquire(doorbell) != s->number)
                return true; // it rang before it ended
            if (farewell)
                return end_session(s, TUBE_END_LOST, "the agent left (farewell %" PRId64 "): %.*s", farewell,
                                   (int)sizeof s->command->farewell_text, s->command->farewell_text);
            if (dead)
                return end_session(s, TUBE_END_LOST, "the agent's process is gone");
            look_at = waited + LOOK_S;
        }
        if (waited < YIELDING_S) {
            sched_yield();
        } else {
            sleep_s(nap);
            nap = fmin(1.2 * nap, NAP_MAX_S);
        }
    }
    return true;
}

static int reset(session *s)
{
    const int64_t lanes = s->settings.lanes;
    memcpy(s->resets, tube_resets(s->command, lanes), (size_t)lanes * sizeof *s->resets);
    for (int64_t i = 0; i < lanes; i++)
        if (tube_check_reset(&s->refusal, i, &s->resets[i], &s->tubes))
            return TUBE_STATUS_REFUSED;
    for (int64_t i = 0; i < lanes; i++)
        if (s->resets[i].selected) {
            memset(&s->poses[i], 0, sizeof s->poses[i]);
            memcpy(&s->poses[i], &s->resets[i], offsetof(tube_pose_row, sim_time)); // both begin with the state
        }
    const int status = s->plant->reset(s->plant->self, s->resets, s->poses, &s->refusal);
    for (int64_t i = 0; i < lanes && status == TUBE_STATUS_DONE; i++)
        if (s->resets[i].selected) {
            s->was_reset[i] = true;
            s->lane_tube[i] = s->resets[i].tube;
        }
    return status;
}

static int step(session *s)
{
    const int64_t lanes = s->settings.lanes;
    for (int64_t i = 0; i < lanes; i++)
        if (!s->was_reset[i])
            return tube_refuse(&s->refusal, TUBE_REFUSAL_NOT_RESET, i, "step", "a lane that was reset", "no reset");
    for (int64_t i = 0; i < lanes; i++)
        if (tube_check_command(&s->refusal, i, &s->commands[i], s->plant->speed_max))
            return TUBE_STATUS_REFUSED;
    for (int64_t i = 0; i < lanes; i++) {
        s->poses[i].contact_steps = 0;
        s->poses[i].step += 1;
        s->poses[i].sim_time = (double)s->poses[i].step * s->settings.dt;
    }
    return s->plant->step(s->plant->self, s->commands, s->poses, &s->refusal);
}

static int register_tube(session *s)
{
    char path[sizeof s->request.tube_path + 1] = {0};
    memcpy(&s->request, s->command, sizeof s->request);
    if (tube_check_registration(&s->refusal, &s->request, &s->tubes))
        return TUBE_STATUS_REFUSED;
    memcpy(path, s->request.tube_path, (size_t)s->request.tube_path_bytes);
    const tube_file tube = {path, s->request.tube_axes, s->request.tube_scale, s->request.tube_sha256};
    const int64_t index = s->request.tube_index;
    const tube_plant *const plant = s->plant;
    const int status = plant->register_tube ? plant->register_tube(plant->self, index, &tube, &s->refusal) : 0;
    s->tubes.taken[index] = status == TUBE_STATUS_DONE;
    return status;
}

static int release_tube(session *s)
{
    const int64_t index = s->command->tube_index;
    if (tube_check_release(&s->refusal, index, &s->tubes, s->lane_tube, s->settings.lanes))
        return TUBE_STATUS_REFUSED;
    const tube_plant *const plant = s->plant;
    const int status = plant->release_tube ? plant->release_tube(plant->self, index, &s->refusal) : 0;
    s->tubes.taken[index] = status != TUBE_STATUS_DONE;
    return status;
}

static int carry_out(session *s, int64_t op)
{
    switch (op) {
    case TUBE_OP_STEP: return step(s);
    case TUBE_OP_RESET: return reset(s);
    case TUBE_OP_REGISTER_TUBE: return register_tube(s);
    case TUBE_OP_RELEASE_TUBE: return release_tube(s);
    default: return TUBE_STATUS_DONE; // a goodbye asks for nothing but its reply
    }
}

static bool publish(session *s, int status, int64_t engine_ns, int64_t number)
{
    tube_pose_segment *const pose = s->pose;
    const size_t bytes = (size_t)s->settings.lanes * sizeof *s->poses;
    if (acquire(&s->command->doorbell) != number || acquire(&s->command->begin) != number)
        return end_session(s, TUBE_END_VIOLATION, "wrote an early request: %" PRId64 " was not answered", number);
    __atomic_store_n(&pose->begin, number, __ATOMIC_RELAXED);
    __atomic_thread_fence(__ATOMIC_RELEASE);
    if (status == TUBE_STATUS_REFUSED) {
        memcpy(&pose->refusal_code, &s->refusal, sizeof s->refusal);
        memcpy(s->poses, tube_poses(pose), bytes); // a plant that refuses half-way may have written some of them
    } else {
        memcpy(tube_poses(pose), s->poses, bytes);
    }
    pose->status = status;
    pose->step = s->steps;
    pose->engine_ns = status == TUBE_STATUS_REFUSED ? 0 : engine_ns;
    release(&pose->end, number);
    release(&pose->doorbell, number);
    s->number = number;
    return true;
}

// Answers the request whose doorbell has rung; false if it was the last.
static bool answer(session *s)
{
    const tube_command_segment *const command = s->command;
    const int64_t due = s->number + 1, rung = acquire(&command->doorbell);
    if (rung != due)
        return end_session(s, TUBE_END_VIOLATION, "rang doorbell %" PRId64 " where %" PRId64 " was due", rung, due);
    memcpy(s->commands, tube_commands(command), (size_t)s->settings.lanes * sizeof *s->commands);
    const int64_t begin = acquire(&command->begin), end = acquire(&command->end);
    if (begin != due || end != due)
        return end_session(s, TUBE_END_VIOLATION, "tore a request: begin %" PRId64 ", end %" PRId64, begin, end);
    const int64_t op = command->op, asked = command->step, next = s->steps + (op == TUBE_OP_STEP);
    if (op < TUBE_OP_STEP || op > TUBE_OP_GOODBYE)
        return end_session(s, TUBE_END_VIOLATION, "asked for an unknown op %" PRId64, op);
    if (asked != next)
        return end_session(s, TUBE_END_VIOLATION, "%s a step: asked for step %" PRId64 " where %" PRId64 " was due",
                           asked < next ? "repeated" : "skipped", asked, next);
    const int64_t began = now_ns();
    const int status = carry_out(s, op);
    const int64_t engine_ns = now_ns() - began;
    if (status != TUBE_STATUS_DONE && status != TUBE_STATUS_REFUSED)
        return end_session(s, TUBE_END_FAILED, "%s", s->refusal.found);
    const int64_t lost = status == TUBE_STATUS_DONE ? tube_first_not_finite(s->poses, s->settings.lanes) : -1;
    if (lost >= 0)
        return end_session(s, TUBE_END_FAILED, "lane %" PRId64 ": its state is no longer finite", lost);
    s->steps += op == TUBE_OP_STEP && status == TUBE_STATUS_DONE;
    if (!publish(s, status, engine_ns, due))
        return false;
    return op != TUBE_OP_GOODBYE || end_session(s, TUBE_END_GOODBYE, "goodbye after %" PRId64 " steps", s->steps);
}

static void leave(session *s)
{
    if (s->pose != NULL && s->ending != TUBE_END_GOODBYE) {
        memcpy(s->pose->farewell_text, s->message, sizeof s->message);
        release(&s->pose->farewell, s->ending == TUBE_END_LOST ? TUBE_FAREWELL_STOPPED : (int64_t)s->ending);
    }
    if (s->pose != NULL && tube_agent_is_dead(&s->segments))
        for (int tries = 100; tries > 0 && !tube_remove_names(&s->segments); tries--)
            sleep_s(0.005);
    tube_close(&s->segments);
    free(s->commands);
    free(s->resets);
    free(s->poses);
    free(s->was_reset);
    free(s->lane_tube);
    free(s->tubes.taken);
}

tube_ending tube_serve(const char *rendezvous, const tube_plant *plant, const volatile sig_atomic_t *stop,
                       char *message, size_t room)
{
    session s = {.plant = plant, .stop = stop};
    if (!tube_parse_rendezvous(&s.segments, rendezvous))
        end_session(&s, TUBE_END_UNUSABLE, "rendezvous: expected shm:NAME or file:/path/stem, found %s", rendezvous);
    else if (attach(&s) && shake_hands(&s))
        while (wait_for_request(&s) && answer(&s))
            continue;
    leave(&s);
    tube_put_text(message, room, "%s", s.message);
    return s.ending;
}
