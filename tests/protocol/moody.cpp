// A plant in C++ on the C library, which misbehaves on some commanded speeds.
#include <cmath>
#include <csignal>
#include <cstdio>

#include "tube_physics.h"

namespace {

struct Moody {
    tube_settings settings;
};

int open_worlds(void *self, const tube_settings *settings, tube_refusal *why)
{
    static_cast<Moody *>(self)->settings = *settings;
    return settings->lanes == 3 ? tube_fail(why, "no room for %d lanes", 3) : TUBE_STATUS_DONE;
}

int reset(void *, const tube_reset_row *, tube_pose_row *, tube_refusal *)
{
    return TUBE_STATUS_DONE;
}

int step(void *self, const tube_command_row *rows, tube_pose_row *poses, tube_refusal *why)
{
    for (int64_t lane = 0; lane < static_cast<Moody *>(self)->settings.lanes; lane++) {
        poses[lane].position[0] += rows[lane].speed;
        poses[lane].contact_steps = 2;
    }
    if (rows->speed == 9.0) // with its poses half written
        return tube_refuse(why, TUBE_REFUSAL_PLANT, 1, "engine", "a mood to step", "none at %g", rows->speed);
    if (rows->speed == 8.0)
        return tube_fail(why, "the engine exploded");
    if (rows->speed == 7.0)
        poses->position[1] = NAN;
    return TUBE_STATUS_DONE;
}

int register_tube(void *, int64_t, const tube_file *tube, tube_refusal *why)
{
    return tube_refuse(why, TUBE_REFUSAL_PLANT, -1, "tube_path", "a file", "%s", tube->path);
}

volatile std::sig_atomic_t stop = 0;

} // namespace

int main(int, char **argv)
{
    Moody moody{};
    tube_plant plant{};
    plant.name = "moody";
    plant.version = "1";
    plant.engine = "C++";
    plant.speed_max = 10.0;
    plant.walls = 1;
    plant.defaults.mass = plant.defaults.inertia_x = plant.defaults.inertia_y = plant.defaults.inertia_z = 1.0;
    plant.defaults.body_radius = 0.1;
    plant.self = &moody;
    plant.open = open_worlds;
    plant.reset = reset;
    plant.step = step;
    plant.register_tube = register_tube;
    char message[1024];
    const tube_ending ending = tube_serve(argv[1], &plant, &stop, message, sizeof message);
    std::fprintf(stderr, "%s\n", message);
    return ending;
}
