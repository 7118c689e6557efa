// Annex A: force and torque from command and state, for plants whose engine integrates. In the protocol's frame.

using Word = TubeCosim.Layout.ParameterIndex;

namespace TubeCosim
{
    public static class ForceLaw
    {
        // Force at the centre of mass (N) without the weight, which the engine applies.
        public static Vector3d Force(LanePose pose, LaneCommand command, double[] parameters, Vector3d gust)
        {
            double mass = parameters[Word.Mass], gain = parameters[Word.ForceGain];
            bool alongBody = parameters[Word.ForceAlongBody] != 0.0;
            Vector3d along = alongBody ? Forward(pose) : command.Direction;
            Vector3d wanted = command.Speed * along - pose.LinearVelocity;
            double lift = command.Compensation * mass * parameters[Word.Gravity];
            Vector3d disturbance = new Vector3d(parameters[Word.DisturbanceX],
                parameters[Word.DisturbanceY], parameters[Word.DisturbanceZ] + lift);
            return mass * gain * wanted - parameters[Word.LinearDrag] * pose.LinearVelocity + disturbance
                + gust;
        }

        // Torque in the world's frame (N m), without the gyroscopic one.
        public static Vector3d Torque(LanePose pose, LaneCommand command, double[] parameters)
        {
            Vector3d wanted = parameters[Word.TorqueKp] * Vector3d.Cross(Forward(pose), command.Direction)
                - parameters[Word.TorqueKd] * pose.AngularVelocity;
            return TimesInertia(pose, parameters, wanted)
                - parameters[Word.AngularDrag] * pose.AngularVelocity;
        }

        // -omega x I omega (N m), for an engine that leaves it out, as PhysX does unless it is asked.
        public static Vector3d Gyroscopic(LanePose pose, double[] parameters)
        {
            return Vector3d.Cross(TimesInertia(pose, parameters, pose.AngularVelocity), pose.AngularVelocity);
        }

        // The random force of a lane's control step, which counts from 1 after its reset.
        public static Vector3d Gust(ulong seed, long step, double amplitude)
        {
            ulong first = unchecked(seed + 3UL * (ulong)(step - 1));
            return amplitude * new Vector3d(Uniform(first), Uniform(unchecked(first + 1)),
                Uniform(unchecked(first + 2)));
        }

        public static ulong SplitMix64(ulong x)
        {
            unchecked
            {
                ulong z = x + 0x9E3779B97F4A7C15UL;
                z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9UL;
                z = (z ^ (z >> 27)) * 0x94D049BB133111EBUL;
                return z ^ (z >> 31);
            }
        }

        // From -1 to 1.
        private static double Uniform(ulong x)
        {
            return 2.0 * ((SplitMix64(x) >> 11) / 9007199254740992.0) - 1.0;
        }

        private static Vector3d Forward(LanePose pose)
        {
            return pose.Rotation.Rotate(new Vector3d(1.0, 0.0, 0.0));
        }

        private static Vector3d TimesInertia(LanePose pose, double[] parameters, Vector3d v)
        {
            Vector3d inBody = pose.Rotation.Inverse().Rotate(v);
            return pose.Rotation.Rotate(new Vector3d(parameters[Word.InertiaX] * inBody.X,
                parameters[Word.InertiaY] * inBody.Y, parameters[Word.InertiaZ] * inBody.Z));
        }
    }
}
