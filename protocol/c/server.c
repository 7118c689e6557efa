// A physics server of one hundred lines: free rigid bodies under the force law of annex A, without walls or gusts.
// The same arithmetic, in the same order, as protocol/toy.py; with -ffp-contract=off the two agree bit for bit.
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "tube_physics.h"

static tube_settings session;
static tube_parameters *lanes; // one a lane, from its last reset

static double along(const double axis[3], const double v[3])
{
    return axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2];
}

// Advances one body by h seconds; force and torque are those of the state at the beginning.
static void inner_step(tube_pose_row *body, const tube_command_row *command, const tube_parameters *p, double h)
{
    double *X = body->position, *q = body->quaternion, *V = body->linear_velocity, *omega = body->angular_velocity;
    const double x = q[0], y = q[1], z = q[2], w = q[3], *d = command->direction;
    const double forward[3] = {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)};
    const double left[3] = {2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)};
    const double up[3] = {2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)};

    const double *a = p->force_along_body != 0.0 ? forward : d;
    const double thrust = p->mass * p->force_gain, drag = p->linear_drag, v = command->speed;
    const double lift = command->compensation * p->mass * p->gravity;
    V[0] = V[0] + h * ((thrust * (v * a[0] - V[0]) - drag * V[0] + p->disturbance_x) / p->mass);
    V[1] = V[1] + h * ((thrust * (v * a[1] - V[1]) - drag * V[1] + p->disturbance_y) / p->mass);
    V[2] = V[2] + h * ((thrust * (v * a[2] - V[2]) + lift - drag * V[2] + p->disturbance_z) / p->mass - p->gravity);

    // In the body frame f = (1, 0, 0), so f x d = (0, -d_up, d_left), and the inertia is diagonal.
    const double bx = along(forward, omega), by = along(left, omega), bz = along(up, omega);
    const double ix = p->inertia_x, iy = p->inertia_y, iz = p->inertia_z, kp = p->torque_kp, kd = p->torque_kd;
    const double tx = ix * (-kd * bx) - p->angular_drag * bx;
    const double ty = iy * (kp * -along(up, d) - kd * by) - p->angular_drag * by;
    const double tz = iz * (kp * along(left, d) - kd * bz) - p->angular_drag * bz;
    const double gx = (tx - (iz - iy) * by * bz) / ix;
    const double gy = (ty - (ix - iz) * bz * bx) / iy;
    const double gz = (tz - (iy - ix) * bx * by) / iz;
    for (int i = 0; i < 3; i++) {
        omega[i] = omega[i] + h * (forward[i] * gx + left[i] * gy + up[i] * gz);
        X[i] = X[i] + h * V[i];
    }

    const double half = 0.5 * h, ox = omega[0], oy = omega[1], oz = omega[2]; // q' = q + h/2 (omega, 0) q
    q[0] = x + half * (ox * w + oy * z - oz * y);
    q[1] = y + half * (oy * w + oz * x - ox * z);
    q[2] = z + half * (oz * w + ox * y - oy * x);
    q[3] = w - half * (ox * x + oy * y + oz * z);
    const double norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; i++)
        q[i] = q[i] / norm;
}

static int open_worlds(void *self, const tube_settings *settings, tube_refusal *why)
{
    (void)self;
    session = *settings;
    lanes = calloc((size_t)settings->lanes, sizeof *lanes);
    return lanes ? TUBE_STATUS_DONE : tube_fail(why, "no memory for %lld lanes", (long long)settings->lanes);
}

static int reset(void *self, const tube_reset_row *rows, tube_pose_row *poses, tube_refusal *why)
{
    (void)self, (void)poses; // the poses hold the rows' states already
    for (int64_t i = 0; i < session.lanes; i++)
        if (rows[i].selected && rows[i].parameters.gust != 0.0)
            return tube_refuse(why, TUBE_REFUSAL_PLANT, i, "gust", "0, since this plant has no gusts", "%.17g",
                               rows[i].parameters.gust);
    for (int64_t i = 0; i < session.lanes; i++)
        if (rows[i].selected)
            lanes[i] = rows[i].parameters;
    return TUBE_STATUS_DONE;
}

static int step(void *self, const tube_command_row *rows, tube_pose_row *poses, tube_refusal *why)
{
    (void)self, (void)why;
    for (int64_t i = 0; i < session.lanes; i++)
        for (int64_t k = 0; k < session.inner_steps; k++)
            inner_step(&poses[i], &rows[i], &lanes[i], session.dt / (double)session.inner_steps);
    return TUBE_STATUS_DONE;
}

static volatile sig_atomic_t stop;

static void on_signal(int number)
{
    stop = number;
}

int main(int argc, char **argv)
{
    const tube_plant plant = {
        .name = "protocol/c/server.c", .version = "1", .engine = "semi-implicit Euler", .speed_max = 10.0,
        .defaults = {.mass = 1.0, .inertia_x = 0.01, .inertia_y = 0.01, .inertia_z = 0.02, .body_radius = 0.15,
                     .force_gain = 8.0, .torque_kp = 120.0, .torque_kd = 18.0, .gravity = 9.81,
                     .restitution = 0.2, .friction = 0.5},
        .open = open_worlds, .reset = reset, .step = step,
    };
    char message[512];
    if (argc < 2) {
        fprintf(stderr, "usage: %s shm:NAME | file:/path/stem\n", argv[0]);
        return TUBE_END_UNUSABLE;
    }
    signal(SIGINT, on_signal);
    signal(SIGTERM, on_signal);
    const tube_ending ending = tube_serve(argv[argc - 1], &plant, &stop, message, sizeof message);
    fprintf(stderr, "%s: %s\n", argv[0], message);
    free(lanes);
    return ending;
}
