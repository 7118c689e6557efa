// The one place where the protocol's frame (right-handed, Z up) meets Unity's (left-handed, Y up).
// Swapping the axes Y and Z mirrors the world: vectors are swapped, and whatever turns about an axis (a rotation, an
// angular velocity, a torque) changes its sense as well. Each function is its own inverse: it serves both ways.

namespace TubeCosim
{
    public static class Frames
    {
        // Position, velocity, force, direction.
        public static Vector3d Vector(Vector3d v)
        {
            return new Vector3d(v.X, v.Z, v.Y);
        }

        public static Quaterniond Rotation(Quaterniond q)
        {
            return new Quaterniond(-q.X, -q.Z, -q.Y, q.W);
        }

        // Angular velocity, torque.
        public static Vector3d Spin(Vector3d w)
        {
            return new Vector3d(-w.X, -w.Z, -w.Y);
        }

        // Moments of inertia about the body's axes, which are swapped as well: its x axis is forward in both.
        public static Vector3d Inertia(Vector3d moments)
        {
            return new Vector3d(moments.X, moments.Z, moments.Y);
        }
    }
}
